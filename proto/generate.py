# /// script
# dependencies = ["grpcio-tools==1.72.1", "setuptools<81"]
# ///
"""Generates the Python stubs in runtime/ from the .proto files: `uv run proto/generate.py [ROOT]`.

An old protoc makes them, in an environment of its own, which the head of this file describes. Stubs run with the
protobuf that made them and with those of the next major version, so old ones live beside other packages.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import grpc_tools
from grpc_tools import protoc

PROTO = Path(__file__).resolve().parent
HOMES = {
    "inference": "runtime/client/pb",
    "lightpage/v1": "runtime/client/pb",
    "lightpage/onnx": "runtime/model/execution/pb",
}
"""Folders of the stubs, by those of the .proto files."""

INIT = '"""Generated from proto/ by proto/generate.py; do not edit."""\n'


def generate(root: Path) -> list[Path]:
    """Write the stubs below the folder `root` and return them.

    protoc imports by the .proto file's own path, which would claim top-level names such as `lightpage`; imports are
    rewritten to the package that the stubs live in.
    """
    well_known = Path(grpc_tools.__file__).parent / "_proto"
    written: set[Path] = set()
    for folder, home in HOMES.items():
        target, sources = root / home, sorted((PROTO / folder).glob("*.proto"))
        target.mkdir(parents=True, exist_ok=True)
        outputs = [f"--{kind}_out={target}" for kind in ("python", "pyi", "grpc_python")]
        if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", *outputs, *map(str, sources)]) != 0:
            raise SystemExit("protoc failed")
        for parent in (target / folder, *(target / folder).parents):
            if parent.is_relative_to(target):
                (parent / "__init__.py").write_text(INIT, "utf-8")
                written.add(parent / "__init__.py")
        package, top = "lightpage." + home.replace("/", "."), folder.split("/")[0]
        for source in sources:
            serves = re.search(r"^service ", source.read_text("utf-8"), re.M)
            for suffix in ("_pb2.py", "_pb2.pyi", "_pb2_grpc.py"):
                path = target / folder / (source.stem + suffix)
                if suffix == "_pb2_grpc.py" and not serves:
                    path.unlink()
                    continue
                text = re.sub(rf"^from {top}\b", f"from {package}.{top}", path.read_text("utf-8"), flags=re.M)
                path.write_text("# mypy: ignore-errors\n" + text, "utf-8")
                written.add(path)
    return sorted(written)


if __name__ == "__main__":
    for file in generate(Path(sys.argv[1]) if len(sys.argv) > 1 else PROTO.parent):
        print(file)
