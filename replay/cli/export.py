"""``twin export``: a calibrated model for other tools."""

from pathlib import Path

import click

from replay.cli.command import FILE, Command


@click.command(
    cls=Command,
    short_help="Take a calibrated model to other tools.",
    example="twin export model.json --esatan satellite.d --out satellite.patch",
)
@click.argument("model", type=FILE)
@click.option("--out", required=True, type=FILE, help="File to write.")
@click.option("--esatan", "deck", type=FILE, help="The deck that the model came from: writes a patch to it.")
@click.option("--spec", "as_spec", is_flag=True, help="Write the specification with the calibrated values as known.")
def export(model: Path, out: Path, deck: Path | None, as_spec: bool) -> None:
    """Write a calibrated model as a patch to an ESATAN-TMS deck, or as a specification whose values are known.

    A patch multiplies the expression of each coupling by what calibration made of it; apply it with patch -p0.
    """
    from replay.cli.console import notify, print_line
    from replay.cli.models import load_model
    from twin_core.errors import SpecError
    from twin_core.files import write_text

    if (deck is None) == (not as_spec):
        raise click.UsageError("give either --esatan DECK or --spec")
    found = load_model(model)
    if found.effects:
        names = ", ".join(effect.label for effect in found.effects)
        notify([f"{model}: what the loop added is not exported: {names}"])
    if deck is None:
        write_text(out, _known(found.spec, found.values, out))
        print_line(f"wrote {out}: every value known")
        return
    from twin_core.interchange.esatan import read_esatan
    from twin_core.interchange.esatan_patch import as_patch, patched
    from twin_core.network.model import build_network
    from twin_core.network.spec_io import load_spec

    try:
        text = deck.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SpecError(f"{deck}: cannot be read ({error.strerror or error})") from error
    declared = build_network(load_spec(read_esatan(text, str(deck), held=True).data)).parameters.as_dict()
    after, changed, left = patched(text, declared, found.values)
    if not changed:
        raise SpecError(
            f"{deck}: no coupling of it is another one in {model}; is it the deck that the model came from?"
        )
    write_text(out, as_patch(text, after, deck.name))
    notify([f"{deck}: {name} stands in no statement of its own and is not in the patch" for name in left])
    print_line(f"wrote {out}: {len(changed)} couplings changed")


def _known(spec: object, values: dict[str, float], out: Path) -> str:
    """Return a specification with calibrated values as known ones."""
    import yaml

    from replay.cli.console import to_json
    from twin_core.network.calibrated import with_values
    from twin_core.network.spec import TwinSpec

    assert isinstance(spec, TwinSpec)
    data = with_values(spec, values)
    return to_json(data) if out.suffix == ".json" else yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
