"""The manifests for Kubernetes: valid by its own schemas, right in themselves, and taken by this program."""

import re
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import pytest
import yaml

from lightpage.cli.main import EXIT_AGAIN, EXIT_ERROR, EXIT_LOST
from lightpage.runtime.archives.run.ledger import Part
from lightpage.runtime.service.settings import ServiceSettings, service_settings
from tests.deploy import manifests
from tests.deploy.manifests import FOLDER, KUSTOMIZATION
from tests.skips import NO_KUSTOMIZE

ROOT = FOLDER.parents[1]
SETTINGS = FOLDER / "service" / "service.toml"
ALL = dict(manifests.manifests())
INDEX = "$(JOB_COMPLETION_INDEX)"
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["lightpage.commands"]
JOBS = [name for name, manifest in ALL.items() if manifest["kind"] == "Job"]
PODS = [name for name, manifest in ALL.items() if list(manifests.templates(manifest))]


def test_every_file_is_used_and_what_is_used_is_there() -> None:
    used: set[Path] = set()
    for kustomization in manifests.kustomizations():
        (whole,) = manifests.read(kustomization)
        names = [*whole["resources"], *(patch["path"] for patch in whole.get("patches", ()))]
        names += [name for each in whole.get("configMapGenerator", ()) for name in each["files"]]
        paths = {(kustomization.parent / name).resolve() for name in names}
        assert all(path.exists() for path in paths), kustomization
        used |= {kustomization, *(path / KUSTOMIZATION if path.is_dir() else path for path in paths)}
    assert used == {path for path in FOLDER.rglob("*") if path.is_file()}


def test_every_manifest_is_valid() -> None:
    for name, manifest in ALL.items():
        assert manifests.problems(manifest) == [], name
        assert manifests.problems({**manifest, "planted": 1}), name


def test_what_kustomize_makes_of_the_folders_is_valid() -> None:
    def kubectl(*words: str | Path) -> str:
        done = subprocess.run(["kubectl", *words], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
        return done.stdout

    if shutil.which("kubectl") is None or not re.search(r"Kustomize Version: v[5-9]", kubectl("version", "--client")):
        pytest.skip(NO_KUSTOMIZE)
    for kustomization in manifests.kustomizations():
        made = list(yaml.safe_load_all(kubectl("kustomize", kustomization.parent)))
        assert made
        assert [problem for each in made for problem in manifests.problems(each)] == []


def selects(selector: dict[str, str], labels: dict[str, str]) -> bool:
    return selector.items() <= labels.items()


def test_all_that_is_for_the_pods_of_the_service_finds_them() -> None:
    whole = manifests.manifest("StatefulSet", "lightpage")
    (pod,) = manifests.templates(whole)
    labels, spec = pod["metadata"]["labels"], whole["spec"]
    ports = {port["name"]: port["containerPort"] for port in manifests.container(whole)["ports"]}
    services = [each for each in ALL.values() if each["kind"] == "Service"]
    (spread,) = spec["template"]["spec"]["topologySpreadConstraints"]
    budget = manifests.manifest("PodDisruptionBudget", "lightpage")["spec"]
    selectors = [service["spec"]["selector"] for service in services]
    selectors += [each["matchLabels"] for each in (spec["selector"], spread["labelSelector"], budget["selector"])]
    policy = manifests.manifest("NetworkPolicy", "lightpage")["spec"]
    selectors.append(policy["podSelector"]["matchLabels"])
    assert all(selects(selector, labels) for selector in selectors)
    named = {port["targetPort"] for service in services for port in service["spec"]["ports"]}
    assert named | {port["port"] for rule in policy["ingress"] for port in rule["ports"]} == {"grpc", "metrics"}
    assert named <= ports.keys()
    (headless,) = [each for each in services if each["spec"].get("clusterIP") == "None"]
    assert headless["metadata"]["name"] == spec["serviceName"]
    others = [pod for name in PODS if ALL[name]["kind"] != "StatefulSet" for pod in manifests.templates(ALL[name])]
    assert not any(selects(selectors[0], pod.get("metadata", {}).get("labels", {})) for pod in others)


def test_the_monitor_finds_one_service_named_as_the_alerts_ask_for_it() -> None:
    monitor = manifests.manifest("ServiceMonitor", "lightpage")["spec"]
    (endpoint,), selector = monitor["endpoints"], monitor["selector"]["matchLabels"]
    services = [each for each in ALL.values() if each["kind"] == "Service"]
    (found,) = [
        each["metadata"]["name"]
        for each in services
        if selects(selector, each["metadata"]["labels"])
        and endpoint["port"] in [port["name"] for port in each["spec"]["ports"]]
    ]
    assert f'up{{job="{found}"}}' in (FOLDER.parent / "prometheus" / "rules.yml").read_text()
    assert endpoint["scheme"] == "https"


@pytest.mark.parametrize("name", PODS)
def test_a_pod_has_what_it_mounts_and_no_more_rights_than_it_needs(name: str) -> None:
    claims = {each["metadata"]["name"] for each in ALL.values() if each["kind"] == "PersistentVolumeClaim"}
    for pod in manifests.templates(ALL[name]):
        spec = pod["spec"]
        assert (spec["automountServiceAccountToken"], spec["enableServiceLinks"]) == (False, False)
        secured = spec["securityContext"]
        assert (secured["runAsNonRoot"], secured["runAsUser"]) == (True, 10001)  # that of the Dockerfile
        assert secured["seccompProfile"] == {"type": "RuntimeDefault"}
        made = ALL[name]["spec"].get("volumeClaimTemplates", [])
        volumes = [volume["name"] for volume in (*spec["volumes"], *(each["metadata"] for each in made))]
        asked = {v["persistentVolumeClaim"]["claimName"] for v in spec["volumes"] if "persistentVolumeClaim" in v}
        assert asked <= claims
        for container in spec["containers"]:
            own = container["securityContext"]
            assert (own["allowPrivilegeEscalation"], own["readOnlyRootFilesystem"]) == (False, True)
            assert own["capabilities"] == {"drop": ["ALL"]}
            assert "memory" in container["resources"]["limits"]
            assert sorted(mount["name"] for mount in container["volumeMounts"]) == sorted(volumes)
            assert "/tmp" in [mount["mountPath"] for mount in container["volumeMounts"]]
            assert not any("subPath" in mount for mount in container["volumeMounts"])
            ports = [port for each in container.get("ports", ()) for port in (each["name"], each["containerPort"])]
            probes = [probe for name, probe in container.items() if name.endswith("Probe")]
            assert all((probe.get("grpc") or probe["httpGet"])["port"] in ports for probe in probes)


def pod_settings() -> ServiceSettings:
    return service_settings(SETTINGS, {"LIGHTPAGE_STORE": "/state/models", "LIGHTPAGE_SERVICE__THREADS": "4"}).settings


def test_the_service_takes_its_settings_and_finds_every_file_of_them_mounted() -> None:
    whole, settings = manifests.manifest("StatefulSet", "lightpage"), pod_settings()
    container = manifests.container(whole)
    mounted = {Path(mount["mountPath"]) for mount in container["volumeMounts"]}
    tls = settings.tls.files()
    assert tls is not None
    assert not settings.service.insecure
    assert [Path(path).name for path in vars(tls).values()] == ["ca.crt", "tls.crt", "tls.key"]
    files = [Path(settings.service.bundle), settings.service.bundle_key, settings.service.store, *vars(tls).values()]
    assert all(mounted & set(Path(str(path)).parents) for path in files)
    (argument,) = container["args"]
    (generated,) = manifests.read(FOLDER / "service" / KUSTOMIZATION)[0]["configMapGenerator"]
    (volume,) = [each for each in whole["spec"]["template"]["spec"]["volumes"] if each["name"] == "settings"]
    (mount,) = [each for each in container["volumeMounts"] if each["name"] == "settings"]
    assert volume["configMap"]["name"] == generated["name"]
    assert argument == f"--config={mount['mountPath']}/{generated['files'][0]}"
    (variable,) = container["env"]
    assert service_settings(None, {variable["name"]: "4"}).settings.service.threads == 4


def test_the_ports_of_the_settings_are_those_of_the_pod() -> None:
    service, metrics = pod_settings().service, pod_settings().metrics
    addresses = [service.address, service.health_address, f"{metrics.host}:{metrics.port}"]
    ports = manifests.container(manifests.manifest("StatefulSet", "lightpage"))["ports"]
    assert addresses == [f"0.0.0.0:{port['containerPort']}" for port in ports]


def test_kubelet_waits_until_calls_in_flight_have_ended() -> None:
    whole = manifests.manifest("StatefulSet", "lightpage")
    before = manifests.container(whole)["lifecycle"]["preStop"]["sleep"]["seconds"]
    given = whole["spec"]["template"]["spec"]["terminationGracePeriodSeconds"]
    assert given >= before + pod_settings().limits.grace_s + 10  # for the rest to end: calls, health checks, the store


def parsed(words: Sequence[str]) -> dict[str, Any]:
    """Return the parameters that a command line sets; the command is found as `lightpage` finds it, and not run."""
    program, name, *arguments = words
    assert program == "lightpage"
    module, _, attribute = COMMANDS[name].partition(":")
    command: click.Command = getattr(import_module(module), attribute)
    if isinstance(command, click.Group):
        name, *arguments = arguments
        command = command.commands[name]
    return command.make_context(name, list(arguments)).params


def test_the_service_understands_its_command_line() -> None:
    arguments = manifests.container(manifests.manifest("StatefulSet", "lightpage"))["args"]
    assert parsed(["lightpage", "serve", *arguments])["config"] == Path("/settings/service.toml")


@pytest.mark.parametrize("name", JOBS)
def test_every_index_of_a_job_does_its_part_and_they_are_all(name: str) -> None:
    spec, container = ALL[name]["spec"], manifests.container(ALL[name])
    assert spec["completionMode"] == "Indexed"
    parts = []
    for index in range(spec["completions"]):
        words = (*container["command"], *container["args"])
        options = parsed([word.replace(INDEX, str(index)) for word in words])
        parts.append(Part.parse(options["part"]))
        assert options["workers"] * options["threads"] == container["resources"]["limits"]["cpu"]
    assert parts == [Part(index=index, count=len(parts)) for index in range(len(parts))]
    mounted = [mount["mountPath"] for mount in container["volumeMounts"]]
    files = [str(options[key]) for key in ("out", "bundle", "fleet") if options[key]]
    assert all(f"/{path.split('/')[1]}" in mounted for path in (*files, *options["recordings"]))


@pytest.mark.parametrize("name", JOBS)
def test_what_another_try_would_not_change_is_not_tried_again(name: str) -> None:
    spec = ALL[name]["spec"]
    ignored, final = spec["podFailurePolicy"]["rules"]
    assert (ignored["action"], ignored["onPodConditions"][0]["type"]) == ("Ignore", "DisruptionTarget")
    assert (final["action"], final["onExitCodes"]["operator"]) == ("FailIndex", "In")
    assert final["onExitCodes"]["values"] == [EXIT_ERROR, EXIT_LOST]
    assert EXIT_AGAIN not in final["onExitCodes"]["values"]
    assert spec["template"]["spec"]["restartPolicy"] == "Never"  # what a policy on failures needs
    assert spec["backoffLimitPerIndex"] > 0


def test_the_ray_job_is_understood_and_tells_nobody_of_itself() -> None:
    job = manifests.manifest("RayJob", "lightpage-ray")["spec"]
    words = shlex.split(job["entrypoint"])
    assert not re.search(r"[*?\[$'\"]", job["entrypoint"])  # it passes through shells
    options = parsed(words)
    assert (options["engine"], options["address"]) == ("ray", "auto")
    assert job["backoffLimit"] == 0  # whatever the exit status is, which may say that nothing is left to do
    cluster = job["rayClusterSpec"]
    for pod in manifests.templates(job):
        assert {"name": "RAY_USAGE_STATS_ENABLED", "value": "0"} in pod["spec"]["containers"][0]["env"]
    assert f"ray=={cluster['rayVersion']}\n" in (ROOT / "constraints.txt").read_text()
    for group in cluster["workerGroupSpecs"]:
        (container,) = group["template"]["spec"]["containers"]
        assert container["resources"]["limits"]["cpu"] % options["threads"] == 0
    files = {f"/{str(options[key]).split('/')[1]}" for key in ("out", "fleet")}
    pods = [cluster["headGroupSpec"]["template"], *(group["template"] for group in cluster["workerGroupSpecs"])]
    assert all(files <= {m["mountPath"] for m in pod["spec"]["containers"][0]["volumeMounts"]} for pod in pods)
