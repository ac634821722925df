"""Looks at texts: profiles, calibrations, codes, states of simulated devices and settings in TOML, figures in JSON."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from lightpage.calibration.document import load_calibration
from lightpage.codec.code import load_code
from lightpage.device.profile import Profile, load_profile
from lightpage.device.state import Device, load_device
from lightpage.errors import InvalidInputError
from lightpage.files import read_text
from lightpage.foreign.array import readable
from lightpage.inspection.finding import Fact, Finding
from lightpage.run_files import EVALUATE, RECOVER, REPORT_MARKS
from lightpage.waves.consequences import consequences

_KNOWN = "a profile, a calibration, a code, settings, or figures of an evaluation or a recovery"
_FIGURES = {EVALUATE: "an evaluation", RECOVER: "a recovery"}
MOST_BYTES = 16 << 20
"""Most bytes of a text."""
SERVICE_TABLES = frozenset(
    {"service", "batches", "tls", "inference", "metrics", "traces", "self_calibration", "flight_recorder"}
    | {"limits", "logs", "audit"}
)
"""Tables of a service's settings, whose own module needs Linux."""


def look_at_toml(path: Path, profile: Profile | None) -> Finding:
    """Return what a TOML file is.

    Raises:
        InvalidInputError: it is no TOML, or of no kind that is known here.
    """
    subject = f"file {path}"
    named = path.suffix.lower() == ".toml"
    with readable(subject, "a TOML document"):
        try:
            told = tomllib.loads(read_text(path, subject, "a TOML document"))
        except (tomllib.TOMLDecodeError, InvalidInputError):
            if named:
                raise
            raise InvalidInputError(subject, "a text that is neither TOML nor JSON", _KNOWN) from None
    if sum(isinstance(told[name], dict) for name in told.keys() & Profile.model_fields.keys()) > 1:
        return _profile(path)
    if "calibrated_pages" in told or "turn_rad" in told:
        return _calibration(path, told, profile)
    if "coded_bits" in told:
        return _code(path)
    if told.keys() & SERVICE_TABLES:
        found = Finding(path, "settings of a service")
        found.next.append(f"lightpage serve --config {found.quoted} --print-config")
        return found
    if "cameras" in told or "trigger" in told:
        found = Finding(path, "cameras of a device")
        found.next.append(f"lightpage record --source camera:{found.quoted} --pages 2 --out R.h5")
        return found
    if told.keys() & Device.model_fields.keys():
        found = Finding(path, "state of a simulated device")
        with found.trying("keys of a device"):
            load_device(path)
            found.next.append(f"lightpage simulate --profile bench --device {found.quoted} --pages 10 --out R.h5")
        return found
    keys = ", ".join(list(told)[:10]) or "none"
    raise InvalidInputError(subject, f"TOML with the keys {keys}", _KNOWN)


def look_at_json(path: Path) -> Finding:
    """Return what a JSON file is.

    Raises:
        InvalidInputError: it is no JSON.
    """
    subject = f"file {path}"
    with readable(subject, "a JSON document"):
        told = json.loads(read_text(path, subject, "a JSON document"))
    found = Finding(path, "JSON")
    if isinstance(told, dict):
        found.facts["keys"] = Fact(list(told)[:10], ", ".join(list(told)[:10]))
        if of := next((of for command, of in _FIGURES.items() if REPORT_MARKS[command] <= told.keys()), None):
            found.kind = f"figures of {of}"
            found.next.append(f"lightpage report {found.quoted} --out F.html")
    return found


def _profile(path: Path) -> Finding:
    found = Finding(path, "profile")
    with found.trying("keys of a profile"):
        found.profile = load_profile(path)
        told = consequences(found.profile)
        found.facts |= {
            "name": found.profile.name,
            "symbols a page": told.symbols,
            "camera pixels a symbol": round(told.pixels_per_symbol, 2),
            "walls met": max(told.walls_met),
        }
        found.problems += [*told.refused, *told.doubts]
    found.next.append(f"lightpage profile check {found.quoted}")
    return found


def _calibration(path: Path, told: dict[str, Any], profile: Profile | None) -> Finding:
    found = Finding(path, "calibration")
    with found.trying("keys of a calibration"):
        fitted = load_calibration(path)
        found.facts |= {
            "of profile": fitted.profile_name,
            "coherence": Fact(
                {"before": fitted.coherence_before, "after": fitted.coherence_after},
                f"{fitted.coherence_before:.3f} -> {fitted.coherence_after:.3f}",
            ),
            "pages used": fitted.pages_used,
        }
        if fitted.goodness is not None:
            verdict, lost = fitted.goodness.verdict, fitted.goodness.bits_lost
            value = {"verdict": verdict, "bits_lost": lost}
            found.facts["fit"] = Fact(value, f"{verdict}, about {lost:.2f} bit a symbol lost")
        if profile is not None:
            found.profile = profile
            found.facts["pipe angle, degree"] = round(fitted.angle_deg(profile), 4)
            if profile.name != fitted.profile_name:
                found.problems.append(f"of profile {fitted.profile_name}, not of {profile.name}")
        fitted.check_good(f"calibration {path}", "")
    found.next.append(f"lightpage train --recording R.h5 --calibration {found.quoted} --out RUN")
    return found


def _code(path: Path) -> Finding:
    found = Finding(path, "code of pages")
    with found.trying("keys of a code"):
        found.facts["code"] = load_code(path).describe()
    found.next.append(f"lightpage encode FILE --profile P --code {found.quoted} --out PAGES.h5")
    return found
