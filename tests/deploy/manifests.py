"""The manifests of deploy/kubernetes, and the schemas that they are held against."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from jsonschema import Draft202012Validator
from referencing import Registry, Resource

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
FOLDER = DEPLOY / "kubernetes"
SCHEMAS = Path(__file__).parent / "schemas"
KUSTOMIZATION = "kustomization.yaml"
_schemas = {path.name: json.loads(path.read_text()) for path in sorted(SCHEMAS.glob("*.json"))}
_registry: Registry[Any] = Registry().with_resources(
    (name, Resource.from_contents(schema)) for name, schema in _schemas.items()
)
_files = {kind: name for name, schema in _schemas.items() for kind in schema["kinds"]}


def problems(manifest: dict[str, Any]) -> list[str]:
    """List a manifest's violations of the schema of its kind."""
    kind = f"{manifest['apiVersion']} {manifest['kind']}"  # as the schemas name it
    place = kind.replace("~", "~0").replace("/", "~1").replace(" ", "%20")
    validator = Draft202012Validator({"$ref": f"{_files[kind]}#/kinds/{place}"}, registry=_registry)
    return [f"{error.json_path}: {error.message}" for error in validator.iter_errors(manifest)]


def read(path: Path) -> list[dict[str, Any]]:
    """The documents of a file."""
    return [document for document in yaml.safe_load_all(path.read_text()) if document is not None]


def kustomizations() -> list[Path]:
    """Return the paths of all kustomizations."""
    return sorted(FOLDER.rglob(KUSTOMIZATION))


def manifests() -> Iterator[tuple[str, dict[str, Any]]]:
    """Every manifest that a kustomization lists as a resource, with a name for it."""
    for kustomization in kustomizations():
        (whole,) = read(kustomization)
        for name in whole["resources"]:
            if (path := kustomization.parent / name).is_file():
                for document in read(path):
                    yield f"{path.relative_to(FOLDER)}: {document['kind']} {document['metadata']['name']}", document


def manifest(kind: str, name: str) -> dict[str, Any]:
    """The one of that kind and name."""
    (found,) = [one for _, one in manifests() if (one["kind"], one["metadata"]["name"]) == (kind, name)]
    return found


def templates(value: Any) -> Iterator[dict[str, Any]]:
    """The pods that a manifest makes: their `spec` and `metadata`."""
    if isinstance(value, dict):
        if "containers" in value.get("spec", {}):
            yield value
        for each in value.values():
            yield from templates(each)
    elif isinstance(value, list):
        for each in value:
            yield from templates(each)


def container(manifest: dict[str, Any]) -> dict[str, Any]:
    """The only container of the only pod that a manifest makes."""
    (template,) = templates(manifest)
    (found,) = template["spec"]["containers"]
    assert isinstance(found, dict)
    return found
