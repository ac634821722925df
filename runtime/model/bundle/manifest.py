"""The manifest of a bundle: what it holds, where it came from, and the hash of every file in it."""

import hashlib
import json
import re
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from lightpage.errors import BundleError

FORMAT = "lightpage-bundle"
SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
DECODER = "decoder.onnx"
TWIN = "twin.onnx"
FIELD = "field.onnx"
GOLDEN = "golden.npz"
TABLE = "table.npz"
PILOTS = "pilots.npz"
CONSTANTS = "constants.onnx"
BATCH = "batch.onnx"
"""The decoder for many pages: what follows from the table alone, and frames with that to p; both or neither."""
OPERATORS = "operators.onnx"
FIRST = "first.onnx"
EARLY, STEP = "early.onnx", "step.onnx"
"""Maximum likelihood in graphs: wave operators of a table, first estimate, early step, step; all of them or none."""
ESTIMATOR_FILES = (OPERATORS, FIRST, EARLY, STEP)
REQUIRED_FILES = frozenset({DECODER, TWIN, GOLDEN})
OPTIONAL_FILES = frozenset({FIELD, TABLE, PILOTS, CONSTANTS, BATCH, *ESTIMATOR_FILES})
Precision = Literal["float32", "float16"]
FLOAT32: Precision = "float32"
FLOAT16: Precision = "float16"
_SELF_HASH = "manifest_sha256"

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$")]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Version = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]{0,99}$")]
Scalar = Annotated[float, Field(allow_inf_nan=False)] | int | str | bool | None


class Provenance(BaseModel):
    """Origin of the bundle."""

    model_config = ConfigDict(frozen=True, extra="allow")

    command: str = ""
    seed: int | None = None
    commit: str = ""


class Manifest(BaseModel):
    """Everything about a bundle except its bulk. Texts are TOML documents, page hashes come from `hash_frames`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["lightpage-bundle"] = "lightpage-bundle"
    schema_version: Literal[1] = 1
    name: Annotated[str, Field(min_length=1)]
    version: Version
    created: str
    """UTC, ISO 8601."""
    profile: str
    """The nominal device, as `lightpage.device.profile.Profile.to_toml` writes it."""
    calibration: str
    """The fitted device, TOML."""
    camera_bit_depth: Annotated[int, Field(ge=8, le=16)]
    frame_dtype: Literal["uint8", "uint16"]
    metrics: dict[str, Scalar] = {}
    files: dict[FileName, Sha256] = {}
    calibrated_pages: tuple[Sha256, ...] = ()
    trained_pages: tuple[Sha256, ...] = ()
    table_inputs: tuple[str, ...] = ()
    """Inputs of decoder.onnx that carry a default and may be fed instead."""
    residual_output: str | None = None
    """Optional scalar output of decoder.onnx: how badly the pair fits the homodyne equations, or the calibration."""
    residual_limit: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    """A pair with a larger residual is refused: swapped frames, frames of two shots, or another device."""
    code: str | None = None
    """How user bytes are protected on this device's pages, TOML of a `lightpage.codec.code.Code`; None: not chosen."""
    earlier_codes: tuple[str, ...] = ()
    """Codes that the device's pages were written with before, the oldest first; such pages are still read."""
    precision: Precision = FLOAT32
    """In which decoder.onnx computes its network and waves."""
    provenance: Provenance = Provenance()

    def to_json(self) -> bytes:
        """The manifest as JSON with a hash of itself, so that a damaged manifest is noticed like any other file."""
        # earlier programs know no such field, and refuse it
        data = self.model_dump(mode="json", exclude=None if self.earlier_codes else {"earlier_codes"})
        return (json.dumps(data | {_SELF_HASH: _digest(data)}, indent=2, sort_keys=True) + "\n").encode()


def parse_manifest(text: bytes, subject: str) -> Manifest:
    """Read and check a manifest.

    Args:
        text: the bytes of manifest.json.
        subject: what it is, for the error.

    Raises:
        BundleError: not JSON, another format, a newer schema, damaged, or a wrong key.
    """
    try:
        data = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise BundleError(subject, f"text that is not JSON ({error})", "a JSON object") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        got = data.get("format") if isinstance(data, dict) else type(data).__name__
        raise BundleError(f"{subject}: format", repr(got), repr(FORMAT))
    if data.get("schema_version") != SCHEMA_VERSION:
        raise BundleError(
            f"{subject}: schema_version", repr(data.get("schema_version")), f"{SCHEMA_VERSION}, all this program reads"
        )
    claimed = data.pop(_SELF_HASH, None)
    if claimed != (actual := _digest(data)):
        raise BundleError(f"{subject}: {_SELF_HASH}", f"{claimed} written, {actual} found", "two equal hashes")
    try:
        return Manifest.model_validate(data)
    except ValidationError as error:
        problems = "; ".join(f"{'.'.join(map(str, e['loc']))} = {e['input']!r} ({e['msg']})" for e in error.errors())
        raise BundleError(subject, problems, "a valid manifest") from None


def check_version(version: str, subject: str) -> None:
    """Check the version of a bundle that is to be made.

    Raises:
        BundleError: empty, too long, or with characters that a version may not have.
    """
    try:
        TypeAdapter(Version).validate_python(version)
    except ValidationError:
        expected = "1 to 100 letters, digits and _ . + -, a letter or digit first"
        raise BundleError(subject, repr(version), expected) from None


def version_of(name: str, created: datetime, content: bytes) -> str:
    """A version that no other bundle has: name, time (UTC) and the beginning of a content's hash."""
    plain = re.sub(r"[^A-Za-z0-9_.+-]", "_", name).lstrip("_.+-")[:60] or "bundle"
    return f"{plain}-{created:%Y%m%dT%H%M%SZ}-{sha256(content)[:8]}"


def sha256(data: bytes) -> str:
    """SHA-256 in hex."""
    return hashlib.sha256(data).hexdigest()


def _digest(data: dict[str, Any]) -> str:
    return sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode())


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")
