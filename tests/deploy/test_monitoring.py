"""Dashboard, alerts and configurations ask for what the service shows, and their own programs take them."""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import compose_spec
import pytest
import yaml
from click.testing import CliRunner

from lightpage.runtime.commands.service.serve import serve
from lightpage.runtime.console.application import console_routes
from lightpage.runtime.console.last_pages import LastPages
from lightpage.runtime.console.server import serving
from lightpage.runtime.console.state import ConsoleState
from lightpage.runtime.model.bundle.bundle import Bundle
from lightpage.runtime.model.decoding.decoder import Decoder
from lightpage.runtime.model.decoding.under_way import UnderWay
from lightpage.runtime.service.caller import Caller
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.models.models import Models
from lightpage.runtime.service.models.store import Store
from lightpage.runtime.service.monitoring.metrics import ServiceMetrics
from lightpage.runtime.service.monitoring.monitor import Monitor
from lightpage.runtime.service.pages.reading import read_page
from lightpage.runtime.service.settings import Given, service_settings
from lightpage.runtime.service.stages import Stages
from tests.deploy.manifests import DEPLOY
from tests.release.scripts import script
from tests.runtime import toy

DASHBOARD = DEPLOY / "grafana" / "lightpage.json"
RULES = DEPLOY / "prometheus" / "rules.yml"


def dashboard_expressions() -> Iterator[str]:
    """Yield the dashboard's expressions, those of folded rows too, with variables filled in as Grafana would."""
    whole = json.loads(DASHBOARD.read_text())
    panels = [*whole["panels"], *(panel for row in whole["panels"] for panel in row.get("panels", ()))]
    asked = [target["expr"] for panel in panels for target in panel.get("targets", ())]
    asked += [annotation["expr"] for annotation in whole["annotations"]["list"]]
    for variable in whole["templating"]["list"]:
        if variable["type"] == "query":
            asked.append(re.fullmatch(r"label_values\((.*), \w+\)", variable["query"]["query"])[1])  # type: ignore[index]
    for expression in asked:
        for name, value in (("$__rate_interval", "1m"), ("$instance", ".*"), ("$method", ".*")):
            expression = expression.replace(name, value)
        yield expression


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]


@pytest.fixture(scope="module")
def shown(toy_zip: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The metrics of a service with all its parts that has read pages, as Prometheus gets them."""
    bundle = Bundle.open(toy_zip)
    last_pages, metrics, source = LastPages(), ServiceMetrics(), toy.ToySource(toy.ToyDevice())
    store = Store(tmp_path_factory.mktemp("store"), bundle)
    monitor, models = Monitor(metrics=metrics), Models(Decoder(bundle, threads=1), store)
    plane = DataPlane(models, source, metrics=metrics, observers=[last_pages], monitor=monitor)
    metrics.watch_certificates(lambda: 2e9)
    metrics.watch_batches(UnderWay(), lambda: 1)
    for _ in range(3):
        stages = Stages()
        read_page(plane, None, None, Caller(), stages=stages)
        metrics.timed("ReadPage", stages)
        metrics.call_ended("ReadPage", "OK", "", stages.elapsed_s)
    routes = console_routes(ConsoleState(last_pages, models, monitor, "toy:device"), metrics.registry)
    with serving(routes, 0) as port, urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as reply:
        return str(reply.read(), "utf-8")


def test_every_metric_that_somebody_asks_for_is_shown(shown: str) -> None:
    known = set()
    for name, kind in re.findall(r"^# TYPE (\S+) (\S+)$", shown, re.MULTILINE):
        known |= {f"{name}_{part}" for part in ("bucket", "sum", "count")} if kind == "histogram" else {name}
    asked = [*dashboard_expressions(), *(rule["expr"] for rule in rules())]
    assert len(asked) > 50
    plain = {one: re.sub(r'"[^"]*"', "", one) for one in asked}
    named = {one: set(re.findall(r"\b(?:lightpage|process|python)_\w+", text)) for one, text in plain.items()}
    assert [one for one, names in named.items() if not (names or re.search(r"\b(up|ALERTS)\b", one))] == []
    assert set().union(*named.values()) <= known


def test_every_own_metric_is_on_the_page_of_metrics_with_its_labels(shown: str) -> None:
    families = dict(re.findall(r"^# TYPE (lightpage_\S+) (\S+)$", shown, re.MULTILINE))
    own = {name: kind for name, kind in families.items() if not name.endswith("_created")}
    page = script("build_site").metrics().replace("<wbr>", "")
    rows = re.findall(r"^\| <code>(lightpage_\w+)</code> \| (\w+) \|([^|]*)\|", page, re.MULTILINE)
    told = {name: (kind, set(re.findall(r"`(\w+)`", given))) for name, kind, given in rows if "_bulk_" not in name}
    assert {name: kind for name, (kind, _) in told.items()} == own
    for name, inside in re.findall(r"^(lightpage_\w+)\{(.*)\} ", shown, re.MULTILINE):
        base = name if name in own else re.sub(r"_(bucket|sum|count)$", "", name)
        assert set(re.findall(r'(\w+)="', inside)) - {"le"} <= told.get(base, ("", set(re.findall(r"\w+", inside))))[1]


def test_every_alert_is_tested() -> None:
    alerts = {rule["alert"] for rule in rules()}
    tests = yaml.safe_load(RULES.with_name("rules_test.yml").read_text())["tests"]
    raised = {each["alertname"] for test in tests for each in test.get("alert_rule_test", ()) if each.get("exp_alerts")}
    assert alerts == raised


def test_promtool_takes_rules_configurations_and_what_the_dashboard_asks(tmp_path: Path) -> None:
    if (promtool := shutil.which("promtool")) is None:
        pytest.skip("promtool is not installed")
    asked = [{"record": f"dashboard:{n}", "expr": one} for n, one in enumerate(dashboard_expressions())]
    (tmp_path / "asked.yml").write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": asked}]}))
    for arguments in (
        ("check", "config", "prometheus.yml"),
        ("check", "config", "--syntax-only", "prometheus.tls.yml"),  # its certificates are in a container
        ("test", "rules", "rules_test.yml"),
        ("check", "rules", str(tmp_path / "asked.yml")),
    ):
        command = (promtool, *arguments)
        done = subprocess.run(command, cwd=RULES.parent, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr


def composed(text: str, **variables: str) -> compose_spec.PyCompose:
    """A composition that is valid, with its variables filled in as compose does."""
    filled = re.sub(r"\$\{(\w+):-([^}]*)\}", lambda found: variables.get(found[1], found[2]), text)
    found = compose_spec.PyOptions(apply_merge=True).from_yaml(filled)
    found.validate()
    return found


def test_the_composition_for_other_machines_has_tls_everywhere() -> None:
    text = (DEPLOY / "compose.tls.yml").read_text().replace("!override", "")
    composed(text)
    plain, services = (yaml.safe_load(one)["services"] for one in ((DEPLOY / "compose.yml").read_text(), text))
    own = services["lightpage"]
    arguments = [argument.removeprefix("--").split("=", 1) for argument in plain["lightpage"]["command"]]
    keys = {"source": "source", "address": "address"}
    options = [Given(name, ("service", keys[name]), value) for name, value in arguments if name in keys]
    options += [Given("", ("metrics", "host"), "0.0.0.0"), Given("", ("metrics", "port"), 9100)]
    settings = service_settings(None, plain["lightpage"]["environment"] | own["environment"], options).settings
    assert not settings.service.insecure
    files = settings.tls.files()
    assert files is not None
    mounted = {volume.split(":")[1] for volume in own["volumes"]}
    assert {str(path) for path in vars(files).values()} <= mounted
    scraped = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.tls.yml").read_text())["scrape_configs"][0]
    mounted = {volume.split(":")[1] for volume in services["prometheus"]["volumes"]}
    assert {path for key, path in scraped["tls_config"].items() if key.endswith("_file")} <= mounted
    assert (scraped["scheme"], "prometheus.tls.yml" in str(services["prometheus"]["volumes"])) == ("https", True)


def test_the_composition_on_one_machine_is_what_the_service_takes() -> None:
    own = yaml.safe_load((DEPLOY / "compose.yml").read_text())["services"]["lightpage"]
    result = CliRunner().invoke(serve, [*own["command"], "--print-config"], env=own["environment"])
    assert result.exit_code == 0, result.output


def test_the_composition_is_valid_and_nothing_of_it_can_be_reached_or_written_from_outside() -> None:
    file = DEPLOY / "compose.yml"
    text = file.read_text()
    services = composed(text).services
    assert services is not None
    assert set(services) == {"lightpage", "prometheus", "grafana"}
    volumes = set(composed(text).volumes or {})
    for name, plain in yaml.safe_load(text)["services"].items():
        assert plain["read_only"] is True, name
        assert plain["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in plain["security_opt"], name
        assert all(port.startswith("127.0.0.1:") for port in plain["ports"]), name
        for volume in plain["volumes"]:
            source = volume.split(":")[0]
            assert source in volumes or (file.parent / source).exists(), volume
            assert source in volumes or volume.endswith(":ro"), volume


def test_the_parts_of_the_composition_find_each_other() -> None:
    services = yaml.safe_load((DEPLOY / "compose.yml").read_text())["services"]
    (scrape,) = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    (target,) = scrape["static_configs"][0]["targets"]
    host, _, port = target.partition(":")
    assert f"--metrics-port={port}" in services[host]["command"]
    assert scrape["job_name"] == "lightpage"  # as the alerts name it
    provisioned = DEPLOY / "grafana" / "provisioning"
    (source,) = yaml.safe_load((provisioned / "datasources" / "prometheus.yml").read_text())["datasources"]
    assert source["url"].removeprefix("http://").partition(":")[0] in services
    (provider,) = yaml.safe_load((provisioned / "dashboards" / "lightpage.yml").read_text())["providers"]
    mounted = [volume.split(":")[1] for volume in services["grafana"]["volumes"]]
    assert f"{provider['options']['path']}/{DASHBOARD.name}" in mounted
    assert json.loads(DASHBOARD.read_text())["uid"] == "lightpage"
