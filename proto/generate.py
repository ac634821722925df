"""Generates the Python stubs in runtime/pb from the .proto files: `python proto/generate.py [TARGET]`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import grpc_tools
from grpc_tools import protoc

PROTO = Path(__file__).resolve().parent
TARGET = PROTO.parent / "runtime" / "pb"
PACKAGE = "runtime.pb"
INIT = '"""Generated from proto/ by proto/generate.py; do not edit."""\n'


def generate(target: Path) -> list[Path]:
    """Write the stubs below `target` and return them.

    protoc imports by the .proto file's own path, which would claim top-level names such as `lightpage`; imports are
    rewritten to the package that the stubs live in.
    """
    sources = sorted(PROTO.glob("*/**/*.proto"))
    folders = "|".join(sorted({source.relative_to(PROTO).parts[0] for source in sources}))
    target.mkdir(parents=True, exist_ok=True)
    well_known = Path(grpc_tools.__file__).parent / "_proto"
    outputs = [f"--{kind}_out={target}" for kind in ("python", "pyi", "grpc_python")]
    if protoc.main(["protoc", f"-I{PROTO}", f"-I{well_known}", *outputs, *map(str, sources)]) != 0:
        raise SystemExit("protoc failed")
    written: list[Path] = []
    for source in sources:
        folder = target / source.parent.relative_to(PROTO)
        for parent in (folder, *folder.parents):
            if parent.is_relative_to(target):
                (parent / "__init__.py").write_text(INIT, "utf-8")
                written.append(parent / "__init__.py")
        serves = re.search(r"^service ", source.read_text("utf-8"), re.M)
        for suffix in ("_pb2.py", "_pb2.pyi", "_pb2_grpc.py"):
            path = folder / (source.stem + suffix)
            if suffix == "_pb2_grpc.py" and not serves:
                path.unlink()
                continue
            text = re.sub(rf"^from ({folders})\b", rf"from {PACKAGE}.\1", path.read_text("utf-8"), flags=re.M)
            path.write_text("# mypy: ignore-errors\n" + text, "utf-8")
            written.append(path)
    return sorted(set(written))


if __name__ == "__main__":
    for file in generate(Path(sys.argv[1]) if len(sys.argv) > 1 else TARGET):
        print(file)
