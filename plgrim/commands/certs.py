"""`plgrim certs init|issue|revoke|list|trust`: the certificates of a deployment."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

Ca = Annotated[Path, typer.Option("--ca", help="Folder of the certificate authority. Keep it off the robot.")]
Robot = Annotated[str, typer.Option("--robot", help="Name of the robot, as `robot` in the configuration.")]
_DEFAULT_CA = Path("plgrim-ca")

certs = typer.Typer(
    name="certs", help="Certificates for mutual TLS: who may connect, and as what.", no_args_is_help=True
)


@certs.command()
def init(
    ca: Ca = _DEFAULT_CA,
    days: Annotated[float, typer.Option(min=1, help="How long the authority lasts.")] = 3650,
) -> None:
    """Make a certificate authority. Example: plgrim certs init --ca plgrim-ca"""
    from plgrim.security.certificates import Authority

    Authority.create(ca, days)
    print(f"certificate authority in {ca}/: keep ca.key secret, and off robot and base")


@certs.command()
def issue(
    role: Annotated[str, typer.Option(help="Of the host: robot, base, or all for a single one.")] = "all",
    process: Annotated[
        list[str] | None,
        typer.Option("--process", help="Only of this one, as gcp (default: all of the role's)."),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address under which others reach this host; may be repeated."),
    ] = None,
    ca: Ca = _DEFAULT_CA,
    robot: Robot = "robot",
    out: Annotated[Path, typer.Option("--out", help="Gets a folder for each process.")] = Path("certs"),
    days: Annotated[float, typer.Option(min=0.01, help="How long they last.")] = 365,
    renew: Annotated[bool, typer.Option("--renew", help="Revoke those that are valid.")] = False,
    owner: Annotated[
        int | None,
        typer.Option(min=0, help="Give the files to this user id; that of the containers is 10001."),
    ] = None,
) -> None:
    """Issue the certificates of a host. Example: plgrim certs issue --role base --host base.local --out base-certs"""
    from plgrim.deployment import processes_of, role_named
    from plgrim.security.access import certificate_name
    from plgrim.security.certificates import Authority

    authority = Authority(ca)
    chosen = tuple(process) if process else processes_of(role_named(role))
    for name in chosen:
        # "router": its name in the compose files, which no other process may listen under.
        local = {"router": ("localhost", "127.0.0.1", "router"), "status": ("localhost", "127.0.0.1")}.get(
            name
        )
        hosts = (*local, *(host or ())) if local else ()
        record = authority.issue(certificate_name(name, role, robot), out / name, hosts, days, renew)
        print(f"{record.name}  until {record.valid_until}  in {out / name}/")
    authority.trust(out)
    if owner is not None:
        for path in [out, *out.rglob("*")]:
            os.chown(path, owner, owner, follow_symlinks=False)
    print(
        "give the new trusted.pem to every other host that has certificates: plgrim certs trust --out FOLDER"
    )


@certs.command()
def revoke(
    name: Annotated[str, typer.Argument(help="As gcp.base.husky1; see `list`.")], ca: Ca = _DEFAULT_CA
) -> None:
    """Revoke a certificate. Example: plgrim certs revoke gcp.base.robot"""
    from plgrim.security.certificates import Authority

    for record in Authority(ca).revoke(name):
        print(f"{record.name} ({record.serial}) is revoked")
    print("it stays out once the new trusted.pem is on every host: plgrim certs trust --out FOLDER")


@certs.command()
def trust(
    out: Annotated[Path, typer.Option("--out", help="Folder with certificates.")] = Path("certs"),
    ca: Ca = _DEFAULT_CA,
) -> None:
    """Renew every trusted.pem in a folder. Example: plgrim certs trust --out base-certs"""
    from plgrim.security.certificates import Authority

    for path in Authority(ca).trust(out):
        print(f"{path}: renewed")


@certs.command("list")
def list_(ca: Ca = _DEFAULT_CA) -> None:
    """List what was issued. Example: plgrim certs list"""
    from plgrim.security.certificates import Authority, utc_now

    now = utc_now()
    for record in Authority(ca).records():
        print(f"{record.state(now):8} {record.name:32} until {record.valid_until}  {record.serial}")


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    app.add_typer(certs)
