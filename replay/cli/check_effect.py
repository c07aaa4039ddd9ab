"""``twin check-effect``: whether a plug-in's effects keep the conventions and state the right derivatives."""

from pathlib import Path

import click

from replay.cli.command import FILE, Command


@click.command(
    "check-effect",
    cls=Command,
    short_help="Check an effect of your own.",
    example="twin check-effect examples/effects/louver.py",
)
@click.argument("file", metavar="FILE.py", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Print the checks as JSON.")
def check_effect(file: Path, as_json: bool) -> None:
    """Check the effects of a Python file: conventions, null, energy and sign, and every derivative.

    Derivatives are compared with central differences in a small network with every kind of node, boundary, conductor,
    radiator and load. Exits with 0 if every check passes, else with 2.
    """
    from replay.cli.console import print_line, to_json
    from twin_core.effects import load_effects
    from twin_core.effects.check import CHECKS, require_sound
    from twin_core.effects.check import check_effect as checks_of

    kinds = load_effects([file], check=False)
    checks = {kind: checks_of(kind) for kind in kinds}
    if as_json:
        rows = [
            {
                "effect": kind.name,
                "passed": all(check.passed for check in found),
                "checks": [{"check": c.name, "passed": c.passed, "detail": c.detail} for c in found],
            }
            for kind, found in checks.items()
        ]
        print_line(to_json({"file": str(file), "effects": rows}).rstrip())
    width = max(map(len, CHECKS))
    for kind, found in {} if as_json else checks.items():
        print_line(f"{kind.name}: {kind.equation}")
        for check in found:
            print_line(f"  {check.name:{width}}  {'ok   ' if check.passed else 'WRONG'}  {check.detail}")
    require_sound(checks, file)
