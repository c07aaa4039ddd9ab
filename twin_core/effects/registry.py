"""All effects by name: those of the package, then those of installed plug-ins, then those of files that were given."""

from collections.abc import Iterable, Iterator, Mapping

from twin_core.effects.base import Effect
from twin_core.effects.plugins import installed_effects
from twin_core.errors import PluginError


class Registry(Mapping[str, type[Effect]]):
    """Name -> effect. Installed plug-ins are looked for at the first question, so that an import costs nothing."""

    def __init__(self, own: Iterable[type[Effect]]) -> None:
        """Know the effects that are always there."""
        self._kinds = {kind.name: kind for kind in own}
        self._sources: dict[str, str] = {}
        self._looked = False

    def add(self, kind: type[Effect], source: str, plugin: str) -> None:
        """Add the effect of a plug-in, unless it is there.

        Parameters
        ----------
        kind
            The effect.
        source
            Its file or package, for messages.
        plugin
            What model files remember of the source.

        Raises
        ------
        PluginError
            If another effect has that name.
        """
        other = self._all().get(kind.name)
        if other is kind:
            return
        if other is not None:
            whose = self._sources.get(kind.name, "the vocabulary of docs/effects.md")
            raise PluginError(f"{source}: the name '{kind.name}' is taken, by {whose}; give the effect another name")
        kind.plugin = plugin
        self._kinds[kind.name] = kind
        self._sources[kind.name] = source

    def holds(self, kind: type[Effect]) -> bool:
        """Return whether this very effect was added."""
        return self._all().get(kind.name) is kind

    def _all(self) -> dict[str, type[Effect]]:
        if not self._looked:
            self._looked = True
            try:
                for source, plugin, kind in installed_effects():
                    self.add(kind, source, plugin)
            except PluginError:
                self._looked = False
                raise
        return self._kinds

    def __getitem__(self, name: str) -> type[Effect]:
        """Return an effect; KeyError if there is none of that name."""
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        """Yield the names."""
        return iter(self._all())

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._all())
