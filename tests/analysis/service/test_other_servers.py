"""What is cheap to check of the comparison with other servers: arithmetic, messages, pinned packages."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest

from analysis.service.other_servers.calls import arrays_of, infer_request
from analysis.service.other_servers.environments import NAMES, requirements
from analysis.service.other_servers.figures import Comparison, Figure, turned
from analysis.service.other_servers.rivals import MLSERVER_HTTP_PORT, MLSERVER_PORT
from analysis.service.other_servers.graphs import committed
from analysis.service.other_servers.timing import CALLERS, rate
from lightpage.errors import LightpageError
from lightpage.recording.frame_pair import FramePair
from runtime.pb.inference import open_inference_pb2 as oip

ROOT = Path(__file__).resolve().parents[3]
