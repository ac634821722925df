"""Asks the service for its health, exit code the answer: the image's HEALTHCHECK."""

import os
import sys

import click
import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from lightpage.cli.main import run
from lightpage.runtime.client.wire.address import check_address
from lightpage.runtime.client.wire.channel import TlsFiles, open_channel
from lightpage.runtime.commands.client.connection import tls_options

DEFAULT_TARGET = "127.0.0.1:50052"


def is_serving(target: str, service: str = "", timeout_s: float = 3.0, tls: TlsFiles | None = None) -> tuple[bool, str]:
    """Ask `target` (HOST:PORT) for the health of `service`, "" being the server as a whole.

    Returns whether it serves, and one line that says what was heard. An unreachable, silent or unknowing server is not
    healthy; it raises nothing, since to find that out is the question.
    Source: the gRPC health checking protocol, grpc.health.v1.
    """
    with open_channel(target, tls) as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        try:
            response = stub.Check(health_pb2.HealthCheckRequest(service=service), timeout=timeout_s)
        except grpc.RpcError as error:
            told = error.details() or (f"no service {service!r}" if service else "")
            return False, f"{target}: {error.code().name}{': ' * bool(told)}{told}"
    status = health_pb2.HealthCheckResponse.ServingStatus.Name(response.status)
    return response.status == health_pb2.HealthCheckResponse.SERVING, f"{target}: {status}"


@click.command()
@click.option(
    "--target",
    default=lambda: os.environ.get("LIGHTPAGE_HEALTH_TARGET", DEFAULT_TARGET),
    show_default=DEFAULT_TARGET,
    help="HOST:PORT of the service; LIGHTPAGE_HEALTH_TARGET sets it too.",
)
@click.option("--service", default="", help="A full gRPC service name; empty asks for the server as a whole.")
@click.option("--timeout", "timeout_s", default=3.0, show_default=True, help="Seconds to wait for the answer.")
@tls_options(environment=False)  # those of other commands must not change how the image asks
def main(target: str, service: str, timeout_s: float, tls: TlsFiles | None) -> None:
    """Exit with 0 when the service answers SERVING, else with 1."""
    check_address("--target", target)
    serving, said = is_serving(target, service=service, timeout_s=timeout_s, tls=tls)
    click.echo(said, err=not serving)
    sys.exit(0 if serving else 1)


if __name__ == "__main__":
    sys.exit(run(main, name="python -m lightpage.runtime.commands.service.healthcheck"))
