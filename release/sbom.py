"""Writes an SBOM of an image: CycloneDX 1.6, JSON, checked against its schema.

    python release/sbom.py ROOT --out FILE --label KEY=VALUE ...

ROOT is the image's root folder. Labels are the image's. Two images of the same content and labels have the same SBOM.
"""

from __future__ import annotations

import argparse
import json
import sys
import uuid
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from cyclonedx.contrib.license.factories import LicenseFactory
from cyclonedx.contrib.this.builders import this_component
from cyclonedx.model import HashAlgorithm, HashType, Property
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.model.license import DisjunctiveLicense, License
from cyclonedx.output.json import JsonV1Dot6
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from inventory import PREFIX, DebianPackage, Inventory, PythonPackage, debian_ref, python_ref, take
from licences import spdx
from packageurl import PackageURL

OCI = "org.opencontainers.image."
_NAMESPACE = uuid.UUID("6f0c5b5c-4a3e-5c5e-9a51-8d3d4a0b7d10")


def sbom(inventory: Inventory, labels: Mapping[str, str]) -> str:
    """The SBOM's text.

    Args:
        inventory: contents of the image.
        labels: the image's, by name.

    Raises:
        ValueError: it breaks CycloneDX's schema.
    """
    version = labels.get(f"{OCI}version", "unknown")
    image = Component(
        type=ComponentType.CONTAINER,
        name=labels.get(f"{OCI}title", "lightpage"),
        version=version,
        bom_ref="image",
        licenses=[LicenseFactory().make_with_expression("MIT")],
        properties=[Property(name=name, value=value) for name, value in sorted(labels.items())],
    )
    parts = [python_component(each) for each in inventory.python]
    parts += [debian_component(each, inventory.release) for each in inventory.debian]
    bom = Bom(components=parts)
    bom.metadata.component = image
    bom.metadata.timestamp = datetime.fromisoformat(labels[f"{OCI}created"]).astimezone(UTC)
    bom.metadata.tools.components.add(this_component())
    bom.register_dependency(image, parts)
    content = json.dumps([sorted(labels.items()), *sorted(str(part.bom_ref) for part in parts)])
    bom.serial_number = uuid.uuid5(_NAMESPACE, content)
    text = JsonV1Dot6(bom).output_as_string(indent=1)
    if (error := JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)) is not None:
        raise ValueError(f"the SBOM is none of CycloneDX 1.6: {error}")
    return text + "\n"


def python_component(package: PythonPackage) -> Component:
    """A distribution, with its libraries inside."""
    reference = python_ref(package)
    expression = spdx(package.name, package.licence)
    licence: License | None = None
    if expression is not None:
        licence = LicenseFactory().make_from_string(expression)
    elif package.licence:
        licence = DisjunctiveLicense(name=package.licence)
    properties = [Property(name=f"{PREFIX}record-sha256", value=package.record_sha256)]
    if package.wheel:
        properties.append(Property(name=f"{PREFIX}wheel", value=package.wheel))
    return Component(
        type=ComponentType.LIBRARY,
        name=package.name,
        version=package.version,
        bom_ref=reference,
        purl=PackageURL.from_string(reference),
        hashes=[HashType(alg=HashAlgorithm.SHA_256, content=package.sha256)] if package.sha256 else [],
        licenses=[licence] if licence is not None else [],
        properties=properties,
        components=[
            Component(
                type=ComponentType.FILE,
                name=path,
                bom_ref=f"{reference}#{path}",
                hashes=[HashType(alg=HashAlgorithm.SHA_256, content=digest)],
            )
            for path, digest in package.libraries.items()
        ],
    )


def debian_component(package: DebianPackage, release: str) -> Component:
    """A package of Debian."""
    reference = debian_ref(package, release)
    return Component(
        type=ComponentType.LIBRARY,
        name=package.name,
        version=package.version,
        bom_ref=reference,
        purl=PackageURL.from_string(reference),
        licenses=[DisjunctiveLicense(name=name) for name in package.licences],
        properties=[
            Property(name=f"{PREFIX}debian-section", value=package.section),
            Property(name=f"{PREFIX}record-sha256", value=package.record_sha256),
        ],
    )


def main(arguments: Sequence[str]) -> int:
    """Run the command that the head of the file describes."""
    parser = argparse.ArgumentParser(description="Write an SBOM of an image.")
    parser.add_argument("root", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--label", action="append", default=[])
    given = parser.parse_args(arguments)
    labels = dict(label.split("=", 1) for label in given.label)
    inventory = take(given.root)
    for fault in inventory.faults:
        print(f"sbom: {fault}", file=sys.stderr)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(sbom(inventory, labels))
    libraries = sum(len(each.libraries) for each in inventory.python)
    print(
        f"{given.out}: {len(inventory.python)} Python packages with {libraries} libraries, "
        f"{len(inventory.debian)} Debian packages"
    )
    return 1 if inventory.faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
