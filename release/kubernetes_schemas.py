"""Writes the schemas of tests/deploy/schemas from packages that have them, in an environment of its own.

    python3.11 -m venv build/schemas
    build/schemas/bin/pip install kubernetes-validate==1.37.0 cloudcoil-models-prometheus-operator==0.80.1.0
    build/schemas/bin/python release/kubernetes_schemas.py

Only the kinds of deploy/kubernetes are taken, with what they refer to, and without descriptions.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path
from typing import Any

KUBERNETES = "v1.33.0"
"""The oldest with all that deploy/kubernetes asks for: `backoffLimitPerIndex` became stable in it."""
KINDS = {
    "apps/v1 StatefulSet": "io.k8s.api.apps.v1.StatefulSet",
    "batch/v1 Job": "io.k8s.api.batch.v1.Job",
    "networking.k8s.io/v1 NetworkPolicy": "io.k8s.api.networking.v1.NetworkPolicy",
    "policy/v1 PodDisruptionBudget": "io.k8s.api.policy.v1.PodDisruptionBudget",
    "v1 ConfigMap": "io.k8s.api.core.v1.ConfigMap",
    "v1 PersistentVolumeClaim": "io.k8s.api.core.v1.PersistentVolumeClaim",
    "v1 Pod": "io.k8s.api.core.v1.Pod",
    "v1 Service": "io.k8s.api.core.v1.Service",
}
METADATA = "io.k8s.apimachinery.pkg.apis.meta.v1.ObjectMeta"
SAID_ONLY = ("description", "title", "default", "$comment")
DRAFT = "https://json-schema.org/draft/2020-12/schema"
SCHEMAS = Path(__file__).resolve().parents[1] / "tests" / "deploy" / "schemas"


def stripped(schema: Any) -> Any:
    """Return a schema without descriptions and without the extensions of Kubernetes."""
    if isinstance(schema, list):
        return [stripped(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    kept = {key: value for key, value in schema.items() if key not in SAID_ONLY and not key.startswith("x-")}
    named = {"properties", "$defs", "patternProperties"}  # their keys are names, not keywords
    return {
        key: {name: stripped(each) for name, each in schema[key].items()} if key in named else stripped(value)
        for key, value in (kept | {key: schema[key] for key in named & schema.keys()}).items()
    }


def strict(schema: Any) -> Any:
    """Return a schema whose objects take no other properties, and whose values are never null."""
    if isinstance(schema, list):
        return [strict(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    kinds = [each for each in schema.get("anyOf", ()) if each != {"type": "null"}]
    if len(kinds) == 1:
        return strict(kinds[0])
    closed = {"additionalProperties": False} if isinstance(schema.get("properties"), dict) else {}
    return closed | {key: strict(value) for key, value in schema.items()}


def referred(schema: Any) -> set[str]:
    """Return the names of the definitions that a schema refers to."""
    if isinstance(schema, list):
        return set().union(*map(referred, schema))
    if not isinstance(schema, dict):
        return set()
    own = {schema["$ref"].rpartition("/")[2]} if isinstance(schema.get("$ref"), str) else set()
    return own.union(*map(referred, schema.values()))


def closure(definitions: dict[str, Any], names: set[str]) -> dict[str, Any]:
    """Return the definitions of these names, and all that they refer to."""
    found: dict[str, Any] = {}
    while names:
        name = names.pop()
        found[name] = definitions[name]
        names |= referred(found[name]) - found.keys()
    return dict(sorted(found.items()))


def kubernetes() -> dict[str, Any]:
    """Return Kubernetes' definitions, and by "apiVersion kind" which of them describes it."""
    folder = files("kubernetes_validate") / "kubernetes-json-schema" / f"{KUBERNETES}-local-strict"
    definitions = json.loads((folder / "_definitions.json").read_text())["$defs"]
    kinds = {told: {"$ref": f"#/$defs/{name}"} for told, name in KINDS.items()}
    comment = f"Kubernetes {KUBERNETES} (Apache-2.0), by kubernetes-validate 1.37.0 (Apache-2.0), v1.33.0-local-strict"
    found = closure(definitions, set(KINDS.values()))
    return {"$schema": DRAFT, "$comment": comment, "kinds": kinds, "$defs": stripped(found)}


def service_monitor() -> dict[str, Any]:
    """Return those of Prometheus operator's ServiceMonitor, whose metadata are Kubernetes' own."""
    from cloudcoil.models.prometheus_operator.v1 import ServiceMonitor  # type: ignore[import-not-found]

    schema = strict(stripped(ServiceMonitor.model_json_schema(by_alias=True)))
    definitions = schema.pop("$defs")
    schema["properties"]["metadata"] = {
        "$ref": "kubernetes.json#/$defs/io.k8s.apimachinery.pkg.apis.meta.v1.ObjectMeta"
    }
    schema["required"] = ["apiVersion", "kind", "metadata", "spec"]
    names = referred(schema) - {METADATA}
    comment = "Prometheus operator v0.80.1 (Apache-2.0), by cloudcoil-models-prometheus-operator 0.80.1.0 (Apache-2.0)"
    kinds = {"monitoring.coreos.com/v1 ServiceMonitor": schema}
    return {"$schema": DRAFT, "$comment": comment, "kinds": kinds, "$defs": closure(definitions, names)}


if __name__ == "__main__":
    for name, found in {"kubernetes": kubernetes(), "servicemonitor": service_monitor()}.items():
        (SCHEMAS / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n")
