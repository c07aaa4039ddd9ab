"""``twin register``: makes a specification known to a running service."""

from pathlib import Path

import click

from replay.cli.command import FILE, Command


@click.command(
    cls=Command,
    short_help="Register a specification with a service.",
    example="twin register benchsat.yaml --url http://127.0.0.1:8000",
)
@click.argument("spec", metavar="SPEC", type=FILE)
@click.option("--url", required=True, help="Where the service listens.")
@click.option("--update", is_flag=True, help="Change the specification of a twin that is registered already.")
@click.option("--key", envvar="TWIN_API_KEY", help="API key of the service.  [default: TWIN_API_KEY]")
@click.option("--json", "as_json", is_flag=True, help="Print the twin as JSON.")
def register(spec: Path, url: str, update: bool, key: str | None, as_json: bool) -> None:
    """Register the specification SPEC, YAML or JSON; the identical one again changes nothing.

    With --update a registered twin is given this specification, keeps its archive, and the models that no longer hold are named.
    """
    from replay.cli.console import notify, print_line, to_json
    from replay.cli.play import check_url
    from replay.errors import ReplayError
    from service.client import ApiError, TwinClient, Unreachable
    from service.schemas import TwinDetail
    from twin_core.network.spec_io import dump_spec, load_spec

    check_url(url)
    given = load_spec(spec)
    try:
        with TwinClient(url, key) as client:
            known = {twin.id for twin in client.twins()}
            made: TwinDetail
            if update and given.twin in known:
                made = revised = client.revise(given.twin, dump_spec(given))
                unfit = [(model.version, ", ".join(model.lacks)) for model in revised.models if model.lacks]
                notify([f"model v{version} was made for another revision: {lacks}" for version, lacks in unfit])
            else:
                made = client.register(dump_spec(given))
    except ApiError as error:
        hint = "; twin register --update changes it" if error.status == 409 and not update else ""
        raise ReplayError(f"{spec}: {error.detail}{hint}") from error
    except Unreachable as error:
        raise ReplayError(str(error)) from error
    line = f"{made.id}: revision {made.revision}, {len(made.channels)} channels, {made.samples} samples"
    print_line(to_json(made.model_dump(mode="json")).rstrip() if as_json else line)
