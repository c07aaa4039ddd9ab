"""``twin export``: a calibrated model for other tools."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from replay.cli.command import FILE, Command

if TYPE_CHECKING:
    from twin_core.calibrate import CalibratedModel


@click.command(
    cls=Command,
    short_help="Take a calibrated model to other tools.",
    example="twin export model.json --fmu --out satellite.fmu",
)
@click.argument("model", type=FILE)
@click.option("--out", required=True, type=FILE, help="File to write.")
@click.option("--fmu", "as_fmu", is_flag=True, help="Write a functional mock-up unit (FMI 3.0) of generated C.")
@click.option("--esatan", "deck", type=FILE, help="The deck that the model came from: writes a patch to it.")
@click.option("--spec", "as_spec", is_flag=True, help="Write the specification with the calibrated values as known.")
@click.option("--json", "as_data", is_flag=True, help="Write values, uncertainties and effects as plain JSON.")
def export(model: Path, out: Path, as_fmu: bool, deck: Path | None, as_spec: bool, as_data: bool) -> None:
    """Write a calibrated model as a functional mock-up unit, a patch to an ESATAN-TMS deck, a specification, or plain JSON.

    A unit runs in any tool that knows FMI 3.0, by Model Exchange or Co-Simulation. A patch multiplies the expression of
    each coupling by what calibration made of it; apply it with patch -p0.
    """
    from replay.cli.console import notify, print_line, to_json
    from replay.cli.models import load_model
    from replay.cli.recordings import check_suffix
    from twin_core.errors import SpecError
    from twin_core.files import write_text

    if sum([as_fmu, deck is not None, as_spec, as_data]) != 1:
        raise click.UsageError("give one of --fmu, --esatan DECK, --spec and --json")
    found = load_model(model)
    if as_fmu:
        from twin_core.fmu import write_fmu

        check_suffix(out, (".fmu",))
        built = write_fmu(found, out)["platform"]
        if built is None:
            notify(
                [f"{out}: no C compiler was found, so that it holds sources alone; the importing tool compiles them"]
            )
        print_line(f"wrote {out}: FMI 3.0, Model Exchange and Co-Simulation" + (f", {built}" if built else ""))
        return
    if as_data:
        write_text(out, to_json(_plain(found)))
        print_line(f"wrote {out}: {len(found.values)} values")
        return
    if found.effects:
        names = ", ".join(effect.label for effect in found.effects)
        notify([f"{model}: what the loop added is not exported: {names}"])
    if deck is None:
        write_text(out, _known(found.spec, found.values, out))
        print_line(f"wrote {out}: every value known")
        return
    from replay.wording import counted
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
    print_line(f"wrote {out}: {counted(len(changed), 'coupling')} changed")


def _plain(model: "CalibratedModel") -> dict[str, Any]:
    """Return a model as data that needs nothing of this program to be read."""
    from twin_core.effects import effect_to_json
    from twin_core.network.calibrated import with_values

    stds = {row["name"]: row.get("std") for row in model.summary.get("parameters", [])}
    return {
        "twin": model.spec.twin,
        "train": model.summary.get("train"),
        "specification": with_values(model.spec, model.values),
        "parameters": [
            {"name": p.name, "unit": p.unit, "value": model.values[p.name], "std": stds.get(p.name), "held": p.frozen}
            for p in model.network().parameters.parameters
        ],
        "effects": [effect_to_json(effect) | {"equation": effect.equation} for effect in model.effects],
        "noise_K": model.noise_K,
    }


def _known(spec: object, values: dict[str, float], out: Path) -> str:
    """Return a specification with calibrated values as known ones."""
    import yaml

    from replay.cli.console import to_json
    from twin_core.network.calibrated import with_values
    from twin_core.network.spec import TwinSpec

    assert isinstance(spec, TwinSpec)
    data = with_values(spec, values)
    return to_json(data) if out.suffix == ".json" else yaml.safe_dump(data, sort_keys=False, default_flow_style=None)
