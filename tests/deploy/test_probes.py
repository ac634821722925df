"""The probes of the manifest, asked as kubelet asks them, of the service that the manifest starts."""

import os
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from tests.deploy import manifests
from tests.runtime.service.models.test_taken_in import Signer
from tests.runtime.service.server.authority import Authority
from tests.waiting import eventually

ROOT = manifests.FOLDER.parents[1]
PROBES = ("startupProbe", "readinessProbe", "livenessProbe")
LIMIT_S = 60


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Pod:
    """The container of the manifest on this machine: its settings, with folders and ports of its own."""

    def __init__(self, folder: Path, bundle: Path) -> None:
        whole = manifests.manifest("StatefulSet", "lightpage")
        self.container = manifests.container(whole)
        self.ports = {port["containerPort"]: free_port() for port in self.container["ports"]}
        self.folder = folder
        self._provide(bundle)
        settings = (manifests.FOLDER / "service" / "service.toml").read_text()
        mounts = [mount["mountPath"] for mount in self.container["volumeMounts"]]
        for mount in mounts:
            (folder / mount.lstrip("/")).mkdir(exist_ok=True)
        settings = re.sub(rf'"({"|".join(mounts)})/', rf'"{folder}\1/', settings)
        for inside, outside in self.ports.items():
            settings = settings.replace(f'"0.0.0.0:{inside}"', f'"127.0.0.1:{outside}"')
            settings = settings.replace(f"port = {inside}", f"port = {outside}")
        self.settings = folder / "settings" / "service.toml"
        self.settings.write_text(settings.replace('"0.0.0.0"', '"127.0.0.1"'))

    def _provide(self, bundle: Path) -> None:
        """Provide what the cluster's administrator provides: certificates, and a signed bundle."""
        folder, authority = self.folder, Authority(self.folder / "authority")
        for name in ("tls", "bundles", "bundle-key"):
            (folder / name).mkdir()
        for path, name in zip(vars(authority.service()).values(), ("ca.crt", "tls.crt", "tls.key"), strict=True):
            shutil.copy(path, folder / "tls" / name)
        Signer(folder / "bundle-key").sign(shutil.copy(bundle, folder / "bundles" / "device.zip"))

    @contextmanager
    def running(self) -> Iterator[subprocess.Popen[str]]:
        """Run the pod's process until the block ends."""
        arguments = [word.replace("/settings", str(self.settings.parent)) for word in self.container["args"]]
        environment = {"LIGHTPAGE_STORE": str(self.folder / "state" / "models"), "PYTHONUNBUFFERED": "1"}
        environment |= {each["name"]: "1" for each in self.container["env"]}
        process = subprocess.Popen(
            [sys.executable, "-m", "lightpage.cli.main", "serve", *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | environment,
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()

    def answers(self, name: str) -> bool:
        """Return whether a probe succeeds: kubelet asks once, without TLS, within the probe's time."""
        probe: dict[str, Any] = self.container[name]
        assert probe.keys() - {"periodSeconds", "timeoutSeconds", "failureThreshold"} == {"grpc"}
        target = f"127.0.0.1:{self.ports[probe['grpc']['port']]}"
        with grpc.insecure_channel(target, options=[("grpc.enable_http_proxy", 0)]) as channel:
            request = health_pb2.HealthCheckRequest(service=probe["grpc"].get("service", ""))
            try:
                reply = health_pb2_grpc.HealthStub(channel).Check(request, timeout=probe["timeoutSeconds"])
            except grpc.RpcError:
                return False
        return bool(reply.status == health_pb2.HealthCheckResponse.SERVING)


def test_the_probes_say_yes_while_it_serves_and_not_before_or_behind(tmp_path: Path, toy_zip: Path) -> None:
    pod = Pod(tmp_path, toy_zip)
    assert not any(pod.answers(name) for name in PROBES)
    with pod.running() as process:

        def runs() -> bool:
            assert process.poll() is None, process.communicate()
            return True

        assert not pod.answers("readinessProbe")  # it loads its bundle
        eventually(lambda: runs() and pod.answers("startupProbe"))
        assert all(pod.answers(name) for name in PROBES)
        process.terminate()
        out, _ = process.communicate(timeout=LIMIT_S)
        assert process.returncode == 0, out
    assert not any(pod.answers(name) for name in PROBES)
