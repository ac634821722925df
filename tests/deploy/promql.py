"""What expressions and configurations of Prometheus and Grafana name."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
DASHBOARD = DEPLOY / "grafana" / "lightpage.json"
RULES = DEPLOY / "prometheus" / "rules.yml"


def metrics_in(expression: str) -> set[str]:
    """Names of the service's metrics, and of its process, with the suffixes that they are asked for with."""
    return set(re.findall(r"\b(?:lightpage|process|python)_\w+", re.sub(r'"[^"]*"', "", expression)))


def dashboard() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(DASHBOARD.read_text())
    return found


def panels() -> list[dict[str, Any]]:
    """All panels, those of folded rows too."""
    shown = dashboard()["panels"]
    return [*shown, *(panel for row in shown for panel in row.get("panels", ()))]


def dashboard_expressions() -> Iterator[str]:
    """What the dashboard asks for, its variables filled in as Grafana would."""
    whole = dashboard()
    asked = [target["expr"] for panel in panels() for target in panel.get("targets", ())]
    asked += [annotation["expr"] for annotation in whole["annotations"]["list"]]
    for variable in whole["templating"]["list"]:
        if variable["type"] == "query":
            asked.append(re.fullmatch(r"label_values\((.*), \w+\)", variable["query"]["query"])[1])  # type: ignore[index]
    for expression in asked:
        yield filled_in(expression)


def filled_in(expression: str) -> str:
    for name, value in (("$__rate_interval", "1m"), ("$instance", ".*"), ("$method", ".*")):
        expression = expression.replace(name, value)
    return expression


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]
