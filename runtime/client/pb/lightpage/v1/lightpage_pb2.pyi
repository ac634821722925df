# mypy: ignore-errors
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ModelOrigin(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODEL_ORIGIN_UNSPECIFIED: _ClassVar[ModelOrigin]
    MODEL_ORIGIN_GIVEN: _ClassVar[ModelOrigin]
    MODEL_ORIGIN_RECALIBRATED: _ClassVar[ModelOrigin]
    MODEL_ORIGIN_UPLOADED: _ClassVar[ModelOrigin]

class PixelType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PIXEL_TYPE_UNSPECIFIED: _ClassVar[PixelType]
    PIXEL_TYPE_UINT8: _ClassVar[PixelType]
    PIXEL_TYPE_UINT16: _ClassVar[PixelType]

class ConfidenceFormat(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CONFIDENCE_FORMAT_UNSPECIFIED: _ClassVar[ConfidenceFormat]
    CONFIDENCE_FORMAT_FLOAT32: _ClassVar[ConfidenceFormat]
    CONFIDENCE_FORMAT_UINT8: _ClassVar[ConfidenceFormat]

class Tracking(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    TRACKING_UNSPECIFIED: _ClassVar[Tracking]
    TRACKING_SESSION: _ClassVar[Tracking]
    TRACKING_STATELESS: _ClassVar[Tracking]

class RecalibrationReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    RECALIBRATION_REASON_UNSPECIFIED: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_PAGE: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_MARGIN: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_INFORMATION: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_TRUST: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_PILOT_SHARE: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_UNREAD: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_RESIDUAL: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_SHIFT: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_PISTON: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_OTHER: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_PAGES: _ClassVar[RecalibrationReason]
    RECALIBRATION_REASON_STROKE: _ClassVar[RecalibrationReason]

class DataLoss(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DATA_LOSS_UNSPECIFIED: _ClassVar[DataLoss]
    DATA_LOSS_OPTICS: _ClassVar[DataLoss]
    DATA_LOSS_HEADER: _ClassVar[DataLoss]
    DATA_LOSS_CODE: _ClassVar[DataLoss]
    DATA_LOSS_BODY: _ClassVar[DataLoss]
    DATA_LOSS_CHECKSUM: _ClassVar[DataLoss]

class JobState(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    JOB_STATE_UNSPECIFIED: _ClassVar[JobState]
    JOB_STATE_RUNNING: _ClassVar[JobState]
    JOB_STATE_DONE: _ClassVar[JobState]
    JOB_STATE_REFUSED: _ClassVar[JobState]
    JOB_STATE_FAILED: _ClassVar[JobState]
    JOB_STATE_CANCELLED: _ClassVar[JobState]
    JOB_STATE_INTERRUPTED: _ClassVar[JobState]

class ErrorReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ERROR_REASON_UNSPECIFIED: _ClassVar[ErrorReason]
    ERROR_REASON_MALFORMED: _ClassVar[ErrorReason]
    ERROR_REASON_INVALID_VALUE: _ClassVar[ErrorReason]
    ERROR_REASON_FRAME_FORMAT: _ClassVar[ErrorReason]
    ERROR_REASON_FRAME_BLACK: _ClassVar[ErrorReason]
    ERROR_REASON_FRAME_SATURATED: _ClassVar[ErrorReason]
    ERROR_REASON_FRAMES_DISAGREE: _ClassVar[ErrorReason]
    ERROR_REASON_PAGE_NOT_BELIEVED: _ClassVar[ErrorReason]
    ERROR_REASON_SHOT_LOST: _ClassVar[ErrorReason]
    ERROR_REASON_NO_SUCH_PAGE: _ClassVar[ErrorReason]
    ERROR_REASON_TOO_LARGE: _ClassVar[ErrorReason]
    ERROR_REASON_OVERLOADED: _ClassVar[ErrorReason]
    ERROR_REASON_DEADLINE_TOO_SHORT: _ClassVar[ErrorReason]
    ERROR_REASON_STALLED: _ClassVar[ErrorReason]
    ERROR_REASON_RECALIBRATION_RUNS: _ClassVar[ErrorReason]
    ERROR_REASON_OTHER_MODEL: _ClassVar[ErrorReason]
    ERROR_REASON_RECALIBRATION_REFUSED: _ClassVar[ErrorReason]
    ERROR_REASON_NO_SOURCE: _ClassVar[ErrorReason]
    ERROR_REASON_SOURCE_BROKEN: _ClassVar[ErrorReason]
    ERROR_REASON_MODEL: _ClassVar[ErrorReason]
    ERROR_REASON_NO_CODE: _ClassVar[ErrorReason]
    ERROR_REASON_STORE: _ClassVar[ErrorReason]
    ERROR_REASON_NO_SUCH_JOB: _ClassVar[ErrorReason]
    ERROR_REASON_STOPPING: _ClassVar[ErrorReason]
    ERROR_REASON_WORKER: _ClassVar[ErrorReason]
    ERROR_REASON_REQUEST_ID: _ClassVar[ErrorReason]
    ERROR_REASON_INTERNAL: _ClassVar[ErrorReason]
    ERROR_REASON_JOB_CANCELLED: _ClassVar[ErrorReason]
    ERROR_REASON_NOT_ALLOWED: _ClassVar[ErrorReason]
    ERROR_REASON_STORAGE: _ClassVar[ErrorReason]
    ERROR_REASON_SURROUNDINGS: _ClassVar[ErrorReason]

class LossReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LOSS_REASON_UNSPECIFIED: _ClassVar[LossReason]
    LOSS_REASON_PILOTS_DISAGREE: _ClassVar[LossReason]
    LOSS_REASON_IMAGE_NOT_FOUND: _ClassVar[LossReason]
    LOSS_REASON_TOO_FEW_PILOTS: _ClassVar[LossReason]
    LOSS_REASON_MISSING_FRAME: _ClassVar[LossReason]
    LOSS_REASON_INCOMPLETE_FRAME: _ClassVar[LossReason]
    LOSS_REASON_SKIPPED_FRAME: _ClassVar[LossReason]
    LOSS_REASON_STRAY_FRAME: _ClassVar[LossReason]
    LOSS_REASON_OTHER_SHOT: _ClassVar[LossReason]
    LOSS_REASON_NOT_SYNCHRONISED: _ClassVar[LossReason]
    LOSS_REASON_CAMERA_GONE: _ClassVar[LossReason]
    LOSS_REASON_TRIGGER_GONE: _ClassVar[LossReason]
    LOSS_REASON_TRIGGER_REFUSED: _ClassVar[LossReason]
    LOSS_REASON_NOT_ON_DISPLAY: _ClassVar[LossReason]
    LOSS_REASON_BEAM_CONTROL_FAILED: _ClassVar[LossReason]
MODEL_ORIGIN_UNSPECIFIED: ModelOrigin
MODEL_ORIGIN_GIVEN: ModelOrigin
MODEL_ORIGIN_RECALIBRATED: ModelOrigin
MODEL_ORIGIN_UPLOADED: ModelOrigin
PIXEL_TYPE_UNSPECIFIED: PixelType
PIXEL_TYPE_UINT8: PixelType
PIXEL_TYPE_UINT16: PixelType
CONFIDENCE_FORMAT_UNSPECIFIED: ConfidenceFormat
CONFIDENCE_FORMAT_FLOAT32: ConfidenceFormat
CONFIDENCE_FORMAT_UINT8: ConfidenceFormat
TRACKING_UNSPECIFIED: Tracking
TRACKING_SESSION: Tracking
TRACKING_STATELESS: Tracking
RECALIBRATION_REASON_UNSPECIFIED: RecalibrationReason
RECALIBRATION_REASON_PAGE: RecalibrationReason
RECALIBRATION_REASON_MARGIN: RecalibrationReason
RECALIBRATION_REASON_INFORMATION: RecalibrationReason
RECALIBRATION_REASON_TRUST: RecalibrationReason
RECALIBRATION_REASON_PILOT_SHARE: RecalibrationReason
RECALIBRATION_REASON_UNREAD: RecalibrationReason
RECALIBRATION_REASON_RESIDUAL: RecalibrationReason
RECALIBRATION_REASON_SHIFT: RecalibrationReason
RECALIBRATION_REASON_PISTON: RecalibrationReason
RECALIBRATION_REASON_OTHER: RecalibrationReason
RECALIBRATION_REASON_PAGES: RecalibrationReason
RECALIBRATION_REASON_STROKE: RecalibrationReason
DATA_LOSS_UNSPECIFIED: DataLoss
DATA_LOSS_OPTICS: DataLoss
DATA_LOSS_HEADER: DataLoss
DATA_LOSS_CODE: DataLoss
DATA_LOSS_BODY: DataLoss
DATA_LOSS_CHECKSUM: DataLoss
JOB_STATE_UNSPECIFIED: JobState
JOB_STATE_RUNNING: JobState
JOB_STATE_DONE: JobState
JOB_STATE_REFUSED: JobState
JOB_STATE_FAILED: JobState
JOB_STATE_CANCELLED: JobState
JOB_STATE_INTERRUPTED: JobState
ERROR_REASON_UNSPECIFIED: ErrorReason
ERROR_REASON_MALFORMED: ErrorReason
ERROR_REASON_INVALID_VALUE: ErrorReason
ERROR_REASON_FRAME_FORMAT: ErrorReason
ERROR_REASON_FRAME_BLACK: ErrorReason
ERROR_REASON_FRAME_SATURATED: ErrorReason
ERROR_REASON_FRAMES_DISAGREE: ErrorReason
ERROR_REASON_PAGE_NOT_BELIEVED: ErrorReason
ERROR_REASON_SHOT_LOST: ErrorReason
ERROR_REASON_NO_SUCH_PAGE: ErrorReason
ERROR_REASON_TOO_LARGE: ErrorReason
ERROR_REASON_OVERLOADED: ErrorReason
ERROR_REASON_DEADLINE_TOO_SHORT: ErrorReason
ERROR_REASON_STALLED: ErrorReason
ERROR_REASON_RECALIBRATION_RUNS: ErrorReason
ERROR_REASON_OTHER_MODEL: ErrorReason
ERROR_REASON_RECALIBRATION_REFUSED: ErrorReason
ERROR_REASON_NO_SOURCE: ErrorReason
ERROR_REASON_SOURCE_BROKEN: ErrorReason
ERROR_REASON_MODEL: ErrorReason
ERROR_REASON_NO_CODE: ErrorReason
ERROR_REASON_STORE: ErrorReason
ERROR_REASON_NO_SUCH_JOB: ErrorReason
ERROR_REASON_STOPPING: ErrorReason
ERROR_REASON_WORKER: ErrorReason
ERROR_REASON_REQUEST_ID: ErrorReason
ERROR_REASON_INTERNAL: ErrorReason
ERROR_REASON_JOB_CANCELLED: ErrorReason
ERROR_REASON_NOT_ALLOWED: ErrorReason
ERROR_REASON_STORAGE: ErrorReason
ERROR_REASON_SURROUNDINGS: ErrorReason
LOSS_REASON_UNSPECIFIED: LossReason
LOSS_REASON_PILOTS_DISAGREE: LossReason
LOSS_REASON_IMAGE_NOT_FOUND: LossReason
LOSS_REASON_TOO_FEW_PILOTS: LossReason
LOSS_REASON_MISSING_FRAME: LossReason
LOSS_REASON_INCOMPLETE_FRAME: LossReason
LOSS_REASON_SKIPPED_FRAME: LossReason
LOSS_REASON_STRAY_FRAME: LossReason
LOSS_REASON_OTHER_SHOT: LossReason
LOSS_REASON_NOT_SYNCHRONISED: LossReason
LOSS_REASON_CAMERA_GONE: LossReason
LOSS_REASON_TRIGGER_GONE: LossReason
LOSS_REASON_TRIGGER_REFUSED: LossReason
LOSS_REASON_NOT_ON_DISPLAY: LossReason
LOSS_REASON_BEAM_CONTROL_FAILED: LossReason

class DescribeRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class DescribeReply(_message.Message):
    __slots__ = ("service_version", "model", "camera", "page", "limits", "source", "source_levels", "profile_toml", "calibration_toml", "pilot_mask", "pilot_phases", "code_toml", "user_bytes_per_page", "default_levels", "steps_s")
    SERVICE_VERSION_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    PAGE_FIELD_NUMBER: _ClassVar[int]
    LIMITS_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SOURCE_LEVELS_FIELD_NUMBER: _ClassVar[int]
    PROFILE_TOML_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_TOML_FIELD_NUMBER: _ClassVar[int]
    PILOT_MASK_FIELD_NUMBER: _ClassVar[int]
    PILOT_PHASES_FIELD_NUMBER: _ClassVar[int]
    CODE_TOML_FIELD_NUMBER: _ClassVar[int]
    USER_BYTES_PER_PAGE_FIELD_NUMBER: _ClassVar[int]
    DEFAULT_LEVELS_FIELD_NUMBER: _ClassVar[int]
    STEPS_S_FIELD_NUMBER: _ClassVar[int]
    service_version: str
    model: Model
    camera: Camera
    page: PageShape
    limits: Limits
    source: str
    source_levels: int
    profile_toml: str
    calibration_toml: str
    pilot_mask: bytes
    pilot_phases: _containers.RepeatedScalarFieldContainer[float]
    code_toml: str
    user_bytes_per_page: int
    default_levels: int
    steps_s: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, service_version: _Optional[str] = ..., model: _Optional[_Union[Model, _Mapping]] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., page: _Optional[_Union[PageShape, _Mapping]] = ..., limits: _Optional[_Union[Limits, _Mapping]] = ..., source: _Optional[str] = ..., source_levels: _Optional[int] = ..., profile_toml: _Optional[str] = ..., calibration_toml: _Optional[str] = ..., pilot_mask: _Optional[bytes] = ..., pilot_phases: _Optional[_Iterable[float]] = ..., code_toml: _Optional[str] = ..., user_bytes_per_page: _Optional[int] = ..., default_levels: _Optional[int] = ..., steps_s: _Optional[_Iterable[float]] = ...) -> None: ...

class Model(_message.Message):
    __slots__ = ("name", "version", "created", "current", "metrics", "pinned", "loaded", "origin")
    class MetricsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    CREATED_FIELD_NUMBER: _ClassVar[int]
    CURRENT_FIELD_NUMBER: _ClassVar[int]
    METRICS_FIELD_NUMBER: _ClassVar[int]
    PINNED_FIELD_NUMBER: _ClassVar[int]
    LOADED_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    name: str
    version: str
    created: str
    current: bool
    metrics: _containers.ScalarMap[str, float]
    pinned: bool
    loaded: bool
    origin: ModelOrigin
    def __init__(self, name: _Optional[str] = ..., version: _Optional[str] = ..., created: _Optional[str] = ..., current: bool = ..., metrics: _Optional[_Mapping[str, float]] = ..., pinned: bool = ..., loaded: bool = ..., origin: _Optional[_Union[ModelOrigin, str]] = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("rows_px", "columns_px", "bit_depth", "pixel_type")
    ROWS_PX_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_PX_FIELD_NUMBER: _ClassVar[int]
    BIT_DEPTH_FIELD_NUMBER: _ClassVar[int]
    PIXEL_TYPE_FIELD_NUMBER: _ClassVar[int]
    rows_px: int
    columns_px: int
    bit_depth: int
    pixel_type: PixelType
    def __init__(self, rows_px: _Optional[int] = ..., columns_px: _Optional[int] = ..., bit_depth: _Optional[int] = ..., pixel_type: _Optional[_Union[PixelType, str]] = ...) -> None: ...

class PageShape(_message.Message):
    __slots__ = ("rows", "columns")
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    rows: int
    columns: int
    def __init__(self, rows: _Optional[int] = ..., columns: _Optional[int] = ...) -> None: ...

class Limits(_message.Message):
    __slots__ = ("message_bytes", "chunk_bytes", "pair_bytes", "concurrent_decodes", "replay_s", "replay_bytes", "recalibration_pages", "model_bytes", "range_pages", "shared_bytes")
    MESSAGE_BYTES_FIELD_NUMBER: _ClassVar[int]
    CHUNK_BYTES_FIELD_NUMBER: _ClassVar[int]
    PAIR_BYTES_FIELD_NUMBER: _ClassVar[int]
    CONCURRENT_DECODES_FIELD_NUMBER: _ClassVar[int]
    REPLAY_S_FIELD_NUMBER: _ClassVar[int]
    REPLAY_BYTES_FIELD_NUMBER: _ClassVar[int]
    RECALIBRATION_PAGES_FIELD_NUMBER: _ClassVar[int]
    MODEL_BYTES_FIELD_NUMBER: _ClassVar[int]
    RANGE_PAGES_FIELD_NUMBER: _ClassVar[int]
    SHARED_BYTES_FIELD_NUMBER: _ClassVar[int]
    message_bytes: int
    chunk_bytes: int
    pair_bytes: int
    concurrent_decodes: int
    replay_s: float
    replay_bytes: int
    recalibration_pages: int
    model_bytes: int
    range_pages: int
    shared_bytes: int
    def __init__(self, message_bytes: _Optional[int] = ..., chunk_bytes: _Optional[int] = ..., pair_bytes: _Optional[int] = ..., concurrent_decodes: _Optional[int] = ..., replay_s: _Optional[float] = ..., replay_bytes: _Optional[int] = ..., recalibration_pages: _Optional[int] = ..., model_bytes: _Optional[int] = ..., range_pages: _Optional[int] = ..., shared_bytes: _Optional[int] = ...) -> None: ...

class DecodeOptions(_message.Message):
    __slots__ = ("levels", "confidence_format", "want_concentration", "want_phase", "want_user_data", "session", "tracking", "least_steps")
    LEVELS_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FORMAT_FIELD_NUMBER: _ClassVar[int]
    WANT_CONCENTRATION_FIELD_NUMBER: _ClassVar[int]
    WANT_PHASE_FIELD_NUMBER: _ClassVar[int]
    WANT_USER_DATA_FIELD_NUMBER: _ClassVar[int]
    SESSION_FIELD_NUMBER: _ClassVar[int]
    TRACKING_FIELD_NUMBER: _ClassVar[int]
    LEAST_STEPS_FIELD_NUMBER: _ClassVar[int]
    levels: int
    confidence_format: ConfidenceFormat
    want_concentration: bool
    want_phase: bool
    want_user_data: bool
    session: str
    tracking: Tracking
    least_steps: int
    def __init__(self, levels: _Optional[int] = ..., confidence_format: _Optional[_Union[ConfidenceFormat, str]] = ..., want_concentration: bool = ..., want_phase: bool = ..., want_user_data: bool = ..., session: _Optional[str] = ..., tracking: _Optional[_Union[Tracking, str]] = ..., least_steps: _Optional[int] = ...) -> None: ...

class Pilots(_message.Message):
    __slots__ = ("mask", "values", "levels")
    MASK_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    LEVELS_FIELD_NUMBER: _ClassVar[int]
    mask: bytes
    values: bytes
    levels: int
    def __init__(self, mask: _Optional[bytes] = ..., values: _Optional[bytes] = ..., levels: _Optional[int] = ...) -> None: ...

class DecodeHeader(_message.Message):
    __slots__ = ("rows_px", "columns_px", "pixel_type", "bit_depth", "options", "pilots", "frame_id", "captured_s", "correlation_id", "black_level", "shared")
    ROWS_PX_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_PX_FIELD_NUMBER: _ClassVar[int]
    PIXEL_TYPE_FIELD_NUMBER: _ClassVar[int]
    BIT_DEPTH_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    PILOTS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CAPTURED_S_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    BLACK_LEVEL_FIELD_NUMBER: _ClassVar[int]
    SHARED_FIELD_NUMBER: _ClassVar[int]
    rows_px: int
    columns_px: int
    pixel_type: PixelType
    bit_depth: int
    options: DecodeOptions
    pilots: Pilots
    frame_id: int
    captured_s: float
    correlation_id: str
    black_level: int
    shared: SharedFrames
    def __init__(self, rows_px: _Optional[int] = ..., columns_px: _Optional[int] = ..., pixel_type: _Optional[_Union[PixelType, str]] = ..., bit_depth: _Optional[int] = ..., options: _Optional[_Union[DecodeOptions, _Mapping]] = ..., pilots: _Optional[_Union[Pilots, _Mapping]] = ..., frame_id: _Optional[int] = ..., captured_s: _Optional[float] = ..., correlation_id: _Optional[str] = ..., black_level: _Optional[int] = ..., shared: _Optional[_Union[SharedFrames, _Mapping]] = ...) -> None: ...

class SharedFrames(_message.Message):
    __slots__ = ("region", "offset")
    REGION_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    region: bytes
    offset: int
    def __init__(self, region: _Optional[bytes] = ..., offset: _Optional[int] = ...) -> None: ...

class DecodeFramesRequest(_message.Message):
    __slots__ = ("header", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: DecodeHeader
    chunk: bytes
    def __init__(self, header: _Optional[_Union[DecodeHeader, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class DecodeReply(_message.Message):
    __slots__ = ("rows", "columns", "levels", "symbols", "confidence", "confidence_format", "concentration", "phase", "piston_rad", "pilot_coherence", "model_version", "timings", "pilot_trust", "claimed_bits", "confirmed_bits", "recalibration_due", "image", "user_data", "frame_id", "captured_s", "correlation_id", "recalibration_reasons", "level_phases")
    ROWS_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_FIELD_NUMBER: _ClassVar[int]
    LEVELS_FIELD_NUMBER: _ClassVar[int]
    SYMBOLS_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FORMAT_FIELD_NUMBER: _ClassVar[int]
    CONCENTRATION_FIELD_NUMBER: _ClassVar[int]
    PHASE_FIELD_NUMBER: _ClassVar[int]
    PISTON_RAD_FIELD_NUMBER: _ClassVar[int]
    PILOT_COHERENCE_FIELD_NUMBER: _ClassVar[int]
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    PILOT_TRUST_FIELD_NUMBER: _ClassVar[int]
    CLAIMED_BITS_FIELD_NUMBER: _ClassVar[int]
    CONFIRMED_BITS_FIELD_NUMBER: _ClassVar[int]
    RECALIBRATION_DUE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    USER_DATA_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CAPTURED_S_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    RECALIBRATION_REASONS_FIELD_NUMBER: _ClassVar[int]
    LEVEL_PHASES_FIELD_NUMBER: _ClassVar[int]
    rows: int
    columns: int
    levels: int
    symbols: bytes
    confidence: bytes
    confidence_format: ConfidenceFormat
    concentration: bytes
    phase: bytes
    piston_rad: float
    pilot_coherence: float
    model_version: str
    timings: Timings
    pilot_trust: float
    claimed_bits: float
    confirmed_bits: float
    recalibration_due: bool
    image: ImagePosition
    user_data: UserData
    frame_id: int
    captured_s: float
    correlation_id: str
    recalibration_reasons: _containers.RepeatedScalarFieldContainer[RecalibrationReason]
    level_phases: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, rows: _Optional[int] = ..., columns: _Optional[int] = ..., levels: _Optional[int] = ..., symbols: _Optional[bytes] = ..., confidence: _Optional[bytes] = ..., confidence_format: _Optional[_Union[ConfidenceFormat, str]] = ..., concentration: _Optional[bytes] = ..., phase: _Optional[bytes] = ..., piston_rad: _Optional[float] = ..., pilot_coherence: _Optional[float] = ..., model_version: _Optional[str] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., pilot_trust: _Optional[float] = ..., claimed_bits: _Optional[float] = ..., confirmed_bits: _Optional[float] = ..., recalibration_due: bool = ..., image: _Optional[_Union[ImagePosition, _Mapping]] = ..., user_data: _Optional[_Union[UserData, _Mapping]] = ..., frame_id: _Optional[int] = ..., captured_s: _Optional[float] = ..., correlation_id: _Optional[str] = ..., recalibration_reasons: _Optional[_Iterable[_Union[RecalibrationReason, str]]] = ..., level_phases: _Optional[_Iterable[float]] = ...) -> None: ...

class DecodePagesReply(_message.Message):
    __slots__ = ("decoded", "refused")
    DECODED_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    decoded: DecodeReply
    refused: Refusal
    def __init__(self, decoded: _Optional[_Union[DecodeReply, _Mapping]] = ..., refused: _Optional[_Union[Refusal, _Mapping]] = ...) -> None: ...

class Refusal(_message.Message):
    __slots__ = ("code", "detail", "reason", "frame_id", "correlation_id", "page")
    CODE_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    PAGE_FIELD_NUMBER: _ClassVar[int]
    code: int
    detail: ErrorDetail
    reason: ErrorReason
    frame_id: int
    correlation_id: str
    page: int
    def __init__(self, code: _Optional[int] = ..., detail: _Optional[_Union[ErrorDetail, _Mapping]] = ..., reason: _Optional[_Union[ErrorReason, str]] = ..., frame_id: _Optional[int] = ..., correlation_id: _Optional[str] = ..., page: _Optional[int] = ...) -> None: ...

class UserData(_message.Message):
    __slots__ = ("data", "loss", "header", "data_pages", "parity_pages", "margin_bits", "corrected", "blocks", "failed_blocks", "iterations", "file_checksum")
    DATA_FIELD_NUMBER: _ClassVar[int]
    LOSS_FIELD_NUMBER: _ClassVar[int]
    HEADER_FIELD_NUMBER: _ClassVar[int]
    DATA_PAGES_FIELD_NUMBER: _ClassVar[int]
    PARITY_PAGES_FIELD_NUMBER: _ClassVar[int]
    MARGIN_BITS_FIELD_NUMBER: _ClassVar[int]
    CORRECTED_FIELD_NUMBER: _ClassVar[int]
    BLOCKS_FIELD_NUMBER: _ClassVar[int]
    FAILED_BLOCKS_FIELD_NUMBER: _ClassVar[int]
    ITERATIONS_FIELD_NUMBER: _ClassVar[int]
    FILE_CHECKSUM_FIELD_NUMBER: _ClassVar[int]
    data: bytes
    loss: DataLoss
    header: PageHeader
    data_pages: int
    parity_pages: int
    margin_bits: float
    corrected: int
    blocks: int
    failed_blocks: int
    iterations: float
    file_checksum: int
    def __init__(self, data: _Optional[bytes] = ..., loss: _Optional[_Union[DataLoss, str]] = ..., header: _Optional[_Union[PageHeader, _Mapping]] = ..., data_pages: _Optional[int] = ..., parity_pages: _Optional[int] = ..., margin_bits: _Optional[float] = ..., corrected: _Optional[int] = ..., blocks: _Optional[int] = ..., failed_blocks: _Optional[int] = ..., iterations: _Optional[float] = ..., file_checksum: _Optional[int] = ...) -> None: ...

class PageHeader(_message.Message):
    __slots__ = ("volume", "page", "volume_bytes", "code_id")
    VOLUME_FIELD_NUMBER: _ClassVar[int]
    PAGE_FIELD_NUMBER: _ClassVar[int]
    VOLUME_BYTES_FIELD_NUMBER: _ClassVar[int]
    CODE_ID_FIELD_NUMBER: _ClassVar[int]
    volume: int
    page: int
    volume_bytes: int
    code_id: int
    def __init__(self, volume: _Optional[int] = ..., page: _Optional[int] = ..., volume_bytes: _Optional[int] = ..., code_id: _Optional[int] = ...) -> None: ...

class ReadDataRequest(_message.Message):
    __slots__ = ("first_page", "pages")
    FIRST_PAGE_FIELD_NUMBER: _ClassVar[int]
    PAGES_FIELD_NUMBER: _ClassVar[int]
    first_page: int
    pages: int
    def __init__(self, first_page: _Optional[int] = ..., pages: _Optional[int] = ...) -> None: ...

class ReadDataReply(_message.Message):
    __slots__ = ("page", "user_data", "restored", "error", "model_version")
    PAGE_FIELD_NUMBER: _ClassVar[int]
    USER_DATA_FIELD_NUMBER: _ClassVar[int]
    RESTORED_FIELD_NUMBER: _ClassVar[int]
    ERROR_FIELD_NUMBER: _ClassVar[int]
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    page: int
    user_data: UserData
    restored: bool
    error: ErrorDetail
    model_version: str
    def __init__(self, page: _Optional[int] = ..., user_data: _Optional[_Union[UserData, _Mapping]] = ..., restored: bool = ..., error: _Optional[_Union[ErrorDetail, _Mapping]] = ..., model_version: _Optional[str] = ...) -> None: ...

class ImagePosition(_message.Message):
    __slots__ = ("shift_x_px", "shift_y_px", "tilt_x_rad", "tilt_y_rad", "searched", "found")
    SHIFT_X_PX_FIELD_NUMBER: _ClassVar[int]
    SHIFT_Y_PX_FIELD_NUMBER: _ClassVar[int]
    TILT_X_RAD_FIELD_NUMBER: _ClassVar[int]
    TILT_Y_RAD_FIELD_NUMBER: _ClassVar[int]
    SEARCHED_FIELD_NUMBER: _ClassVar[int]
    FOUND_FIELD_NUMBER: _ClassVar[int]
    shift_x_px: float
    shift_y_px: float
    tilt_x_rad: float
    tilt_y_rad: float
    searched: bool
    found: bool
    def __init__(self, shift_x_px: _Optional[float] = ..., shift_y_px: _Optional[float] = ..., tilt_x_rad: _Optional[float] = ..., tilt_y_rad: _Optional[float] = ..., searched: bool = ..., found: bool = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("receive_s", "decode_s", "inference_s", "total_s", "steps", "skipped_steps")
    RECEIVE_S_FIELD_NUMBER: _ClassVar[int]
    DECODE_S_FIELD_NUMBER: _ClassVar[int]
    INFERENCE_S_FIELD_NUMBER: _ClassVar[int]
    TOTAL_S_FIELD_NUMBER: _ClassVar[int]
    STEPS_FIELD_NUMBER: _ClassVar[int]
    SKIPPED_STEPS_FIELD_NUMBER: _ClassVar[int]
    receive_s: float
    decode_s: float
    inference_s: float
    total_s: float
    steps: int
    skipped_steps: int
    def __init__(self, receive_s: _Optional[float] = ..., decode_s: _Optional[float] = ..., inference_s: _Optional[float] = ..., total_s: _Optional[float] = ..., steps: _Optional[int] = ..., skipped_steps: _Optional[int] = ...) -> None: ...

class ReadPageRequest(_message.Message):
    __slots__ = ("page", "options", "want_written", "request_id", "correlation_id")
    PAGE_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    WANT_WRITTEN_FIELD_NUMBER: _ClassVar[int]
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    page: int
    options: DecodeOptions
    want_written: bool
    request_id: str
    correlation_id: str
    def __init__(self, page: _Optional[int] = ..., options: _Optional[_Union[DecodeOptions, _Mapping]] = ..., want_written: bool = ..., request_id: _Optional[str] = ..., correlation_id: _Optional[str] = ...) -> None: ...

class ReadPagesRequest(_message.Message):
    __slots__ = ("pages", "count", "options", "want_written", "correlation_id")
    PAGES_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    WANT_WRITTEN_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    pages: _containers.RepeatedScalarFieldContainer[int]
    count: int
    options: DecodeOptions
    want_written: bool
    correlation_id: str
    def __init__(self, pages: _Optional[_Iterable[int]] = ..., count: _Optional[int] = ..., options: _Optional[_Union[DecodeOptions, _Mapping]] = ..., want_written: bool = ..., correlation_id: _Optional[str] = ...) -> None: ...

class ReadPagesReply(_message.Message):
    __slots__ = ("read", "refused")
    READ_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    read: ReadPageReply
    refused: Refusal
    def __init__(self, read: _Optional[_Union[ReadPageReply, _Mapping]] = ..., refused: _Optional[_Union[Refusal, _Mapping]] = ...) -> None: ...

class ReadPageReply(_message.Message):
    __slots__ = ("decoded", "page", "written", "pilot_mask", "frames", "replayed")
    DECODED_FIELD_NUMBER: _ClassVar[int]
    PAGE_FIELD_NUMBER: _ClassVar[int]
    WRITTEN_FIELD_NUMBER: _ClassVar[int]
    PILOT_MASK_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    REPLAYED_FIELD_NUMBER: _ClassVar[int]
    decoded: DecodeReply
    page: int
    written: bytes
    pilot_mask: bytes
    frames: _containers.RepeatedCompositeFieldContainer[CameraFrame]
    replayed: bool
    def __init__(self, decoded: _Optional[_Union[DecodeReply, _Mapping]] = ..., page: _Optional[int] = ..., written: _Optional[bytes] = ..., pilot_mask: _Optional[bytes] = ..., frames: _Optional[_Iterable[_Union[CameraFrame, _Mapping]]] = ..., replayed: bool = ...) -> None: ...

class CameraFrame(_message.Message):
    __slots__ = ("serial", "frame_id", "device_time_s", "host_time_s")
    SERIAL_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    DEVICE_TIME_S_FIELD_NUMBER: _ClassVar[int]
    HOST_TIME_S_FIELD_NUMBER: _ClassVar[int]
    serial: str
    frame_id: int
    device_time_s: float
    host_time_s: float
    def __init__(self, serial: _Optional[str] = ..., frame_id: _Optional[int] = ..., device_time_s: _Optional[float] = ..., host_time_s: _Optional[float] = ...) -> None: ...

class UploadPagesRequest(_message.Message):
    __slots__ = ("levels", "symbols")
    LEVELS_FIELD_NUMBER: _ClassVar[int]
    SYMBOLS_FIELD_NUMBER: _ClassVar[int]
    levels: int
    symbols: bytes
    def __init__(self, levels: _Optional[int] = ..., symbols: _Optional[bytes] = ...) -> None: ...

class UploadPagesReply(_message.Message):
    __slots__ = ("first_page", "pages")
    FIRST_PAGE_FIELD_NUMBER: _ClassVar[int]
    PAGES_FIELD_NUMBER: _ClassVar[int]
    first_page: int
    pages: int
    def __init__(self, first_page: _Optional[int] = ..., pages: _Optional[int] = ...) -> None: ...

class WatchDisplayRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class WatchDisplayReply(_message.Message):
    __slots__ = ("page", "beams")
    PAGE_FIELD_NUMBER: _ClassVar[int]
    BEAMS_FIELD_NUMBER: _ClassVar[int]
    page: int
    beams: Beams
    def __init__(self, page: _Optional[int] = ..., beams: _Optional[_Union[Beams, _Mapping]] = ...) -> None: ...

class Beams(_message.Message):
    __slots__ = ("signal", "reference")
    SIGNAL_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    signal: bool
    reference: bool
    def __init__(self, signal: bool = ..., reference: bool = ...) -> None: ...

class ReportDisplayRequest(_message.Message):
    __slots__ = ("page", "withdrawn", "beams")
    PAGE_FIELD_NUMBER: _ClassVar[int]
    WITHDRAWN_FIELD_NUMBER: _ClassVar[int]
    BEAMS_FIELD_NUMBER: _ClassVar[int]
    page: int
    withdrawn: bool
    beams: Beams
    def __init__(self, page: _Optional[int] = ..., withdrawn: bool = ..., beams: _Optional[_Union[Beams, _Mapping]] = ...) -> None: ...

class ReportDisplayReply(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class RecalibrateRequest(_message.Message):
    __slots__ = ("source", "recording", "recording_count", "expected_version")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    RECORDING_COUNT_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_VERSION_FIELD_NUMBER: _ClassVar[int]
    source: SourcePages
    recording: str
    recording_count: int
    expected_version: str
    def __init__(self, source: _Optional[_Union[SourcePages, _Mapping]] = ..., recording: _Optional[str] = ..., recording_count: _Optional[int] = ..., expected_version: _Optional[str] = ...) -> None: ...

class StartRecalibrationRequest(_message.Message):
    __slots__ = ("source", "recording", "recording_count", "expected_version", "correlation_id")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    RECORDING_FIELD_NUMBER: _ClassVar[int]
    RECORDING_COUNT_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_VERSION_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    source: SourcePages
    recording: str
    recording_count: int
    expected_version: str
    correlation_id: str
    def __init__(self, source: _Optional[_Union[SourcePages, _Mapping]] = ..., recording: _Optional[str] = ..., recording_count: _Optional[int] = ..., expected_version: _Optional[str] = ..., correlation_id: _Optional[str] = ...) -> None: ...

class RecalibrateFramesRequest(_message.Message):
    __slots__ = ("header", "reference", "symbols", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    SYMBOLS_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: RecalibrateFramesHeader
    reference: bytes
    symbols: bytes
    chunk: bytes
    def __init__(self, header: _Optional[_Union[RecalibrateFramesHeader, _Mapping]] = ..., reference: _Optional[bytes] = ..., symbols: _Optional[bytes] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class RecalibrateFramesHeader(_message.Message):
    __slots__ = ("rows_px", "columns_px", "pixel_type", "bit_depth", "black_level", "levels", "pages", "pilot_mask", "expected_version", "correlation_id")
    ROWS_PX_FIELD_NUMBER: _ClassVar[int]
    COLUMNS_PX_FIELD_NUMBER: _ClassVar[int]
    PIXEL_TYPE_FIELD_NUMBER: _ClassVar[int]
    BIT_DEPTH_FIELD_NUMBER: _ClassVar[int]
    BLACK_LEVEL_FIELD_NUMBER: _ClassVar[int]
    LEVELS_FIELD_NUMBER: _ClassVar[int]
    PAGES_FIELD_NUMBER: _ClassVar[int]
    PILOT_MASK_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_VERSION_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    rows_px: int
    columns_px: int
    pixel_type: PixelType
    bit_depth: int
    black_level: int
    levels: int
    pages: int
    pilot_mask: bytes
    expected_version: str
    correlation_id: str
    def __init__(self, rows_px: _Optional[int] = ..., columns_px: _Optional[int] = ..., pixel_type: _Optional[_Union[PixelType, str]] = ..., bit_depth: _Optional[int] = ..., black_level: _Optional[int] = ..., levels: _Optional[int] = ..., pages: _Optional[int] = ..., pilot_mask: _Optional[bytes] = ..., expected_version: _Optional[str] = ..., correlation_id: _Optional[str] = ...) -> None: ...

class Job(_message.Message):
    __slots__ = ("id", "state", "progress", "result", "refusal", "created_s", "ended_s", "correlation_id", "pages_of")
    ID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    REFUSAL_FIELD_NUMBER: _ClassVar[int]
    CREATED_S_FIELD_NUMBER: _ClassVar[int]
    ENDED_S_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    PAGES_OF_FIELD_NUMBER: _ClassVar[int]
    id: str
    state: JobState
    progress: Progress
    result: RecalibrationResult
    refusal: Refusal
    created_s: float
    ended_s: float
    correlation_id: str
    pages_of: str
    def __init__(self, id: _Optional[str] = ..., state: _Optional[_Union[JobState, str]] = ..., progress: _Optional[_Union[Progress, _Mapping]] = ..., result: _Optional[_Union[RecalibrationResult, _Mapping]] = ..., refusal: _Optional[_Union[Refusal, _Mapping]] = ..., created_s: _Optional[float] = ..., ended_s: _Optional[float] = ..., correlation_id: _Optional[str] = ..., pages_of: _Optional[str] = ...) -> None: ...

class ListJobsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListJobsReply(_message.Message):
    __slots__ = ("jobs",)
    JOBS_FIELD_NUMBER: _ClassVar[int]
    jobs: _containers.RepeatedCompositeFieldContainer[Job]
    def __init__(self, jobs: _Optional[_Iterable[_Union[Job, _Mapping]]] = ...) -> None: ...

class GetJobRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class WatchJobRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class CancelJobRequest(_message.Message):
    __slots__ = ("id",)
    ID_FIELD_NUMBER: _ClassVar[int]
    id: str
    def __init__(self, id: _Optional[str] = ...) -> None: ...

class SourcePages(_message.Message):
    __slots__ = ("count", "pages")
    COUNT_FIELD_NUMBER: _ClassVar[int]
    PAGES_FIELD_NUMBER: _ClassVar[int]
    count: int
    pages: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, count: _Optional[int] = ..., pages: _Optional[_Iterable[int]] = ...) -> None: ...

class RecalibrateReply(_message.Message):
    __slots__ = ("progress", "result")
    PROGRESS_FIELD_NUMBER: _ClassVar[int]
    RESULT_FIELD_NUMBER: _ClassVar[int]
    progress: Progress
    result: RecalibrationResult
    def __init__(self, progress: _Optional[_Union[Progress, _Mapping]] = ..., result: _Optional[_Union[RecalibrationResult, _Mapping]] = ...) -> None: ...

class Progress(_message.Message):
    __slots__ = ("step", "fraction")
    STEP_FIELD_NUMBER: _ClassVar[int]
    FRACTION_FIELD_NUMBER: _ClassVar[int]
    step: str
    fraction: float
    def __init__(self, step: _Optional[str] = ..., fraction: _Optional[float] = ...) -> None: ...

class RecalibrationResult(_message.Message):
    __slots__ = ("model_version", "previous_version", "pages_used", "pages_held_back", "air_before", "air_after", "angle_deg", "coherence_before", "coherence_after", "seconds", "pages_lost_before", "image", "air_limit", "air_standard_error", "rounds", "verdict", "bits_lost", "cause")
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_VERSION_FIELD_NUMBER: _ClassVar[int]
    PAGES_USED_FIELD_NUMBER: _ClassVar[int]
    PAGES_HELD_BACK_FIELD_NUMBER: _ClassVar[int]
    AIR_BEFORE_FIELD_NUMBER: _ClassVar[int]
    AIR_AFTER_FIELD_NUMBER: _ClassVar[int]
    ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    COHERENCE_BEFORE_FIELD_NUMBER: _ClassVar[int]
    COHERENCE_AFTER_FIELD_NUMBER: _ClassVar[int]
    SECONDS_FIELD_NUMBER: _ClassVar[int]
    PAGES_LOST_BEFORE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    AIR_LIMIT_FIELD_NUMBER: _ClassVar[int]
    AIR_STANDARD_ERROR_FIELD_NUMBER: _ClassVar[int]
    ROUNDS_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    BITS_LOST_FIELD_NUMBER: _ClassVar[int]
    CAUSE_FIELD_NUMBER: _ClassVar[int]
    model_version: str
    previous_version: str
    pages_used: int
    pages_held_back: int
    air_before: float
    air_after: float
    angle_deg: float
    coherence_before: float
    coherence_after: float
    seconds: float
    pages_lost_before: int
    image: ImagePosition
    air_limit: float
    air_standard_error: float
    rounds: int
    verdict: str
    bits_lost: float
    cause: str
    def __init__(self, model_version: _Optional[str] = ..., previous_version: _Optional[str] = ..., pages_used: _Optional[int] = ..., pages_held_back: _Optional[int] = ..., air_before: _Optional[float] = ..., air_after: _Optional[float] = ..., angle_deg: _Optional[float] = ..., coherence_before: _Optional[float] = ..., coherence_after: _Optional[float] = ..., seconds: _Optional[float] = ..., pages_lost_before: _Optional[int] = ..., image: _Optional[_Union[ImagePosition, _Mapping]] = ..., air_limit: _Optional[float] = ..., air_standard_error: _Optional[float] = ..., rounds: _Optional[int] = ..., verdict: _Optional[str] = ..., bits_lost: _Optional[float] = ..., cause: _Optional[str] = ...) -> None: ...

class RollbackRequest(_message.Message):
    __slots__ = ("expected_version", "correlation_id")
    EXPECTED_VERSION_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    expected_version: str
    correlation_id: str
    def __init__(self, expected_version: _Optional[str] = ..., correlation_id: _Optional[str] = ...) -> None: ...

class RollbackReply(_message.Message):
    __slots__ = ("model_version", "previous_version")
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_VERSION_FIELD_NUMBER: _ClassVar[int]
    model_version: str
    previous_version: str
    def __init__(self, model_version: _Optional[str] = ..., previous_version: _Optional[str] = ...) -> None: ...

class RollForwardRequest(_message.Message):
    __slots__ = ("expected_version", "correlation_id")
    EXPECTED_VERSION_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    expected_version: str
    correlation_id: str
    def __init__(self, expected_version: _Optional[str] = ..., correlation_id: _Optional[str] = ...) -> None: ...

class RollForwardReply(_message.Message):
    __slots__ = ("model_version", "previous_version")
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_VERSION_FIELD_NUMBER: _ClassVar[int]
    model_version: str
    previous_version: str
    def __init__(self, model_version: _Optional[str] = ..., previous_version: _Optional[str] = ...) -> None: ...

class ListModelsRequest(_message.Message):
    __slots__ = ("stored",)
    STORED_FIELD_NUMBER: _ClassVar[int]
    stored: bool
    def __init__(self, stored: bool = ...) -> None: ...

class UploadModelRequest(_message.Message):
    __slots__ = ("header", "chunk")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    CHUNK_FIELD_NUMBER: _ClassVar[int]
    header: UploadModelHeader
    chunk: bytes
    def __init__(self, header: _Optional[_Union[UploadModelHeader, _Mapping]] = ..., chunk: _Optional[bytes] = ...) -> None: ...

class UploadModelHeader(_message.Message):
    __slots__ = ("bytes", "sha256", "correlation_id", "signature")
    BYTES_FIELD_NUMBER: _ClassVar[int]
    SHA256_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    SIGNATURE_FIELD_NUMBER: _ClassVar[int]
    bytes: int
    sha256: bytes
    correlation_id: str
    signature: bytes
    def __init__(self, bytes: _Optional[int] = ..., sha256: _Optional[bytes] = ..., correlation_id: _Optional[str] = ..., signature: _Optional[bytes] = ...) -> None: ...

class UploadModelReply(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: Model
    def __init__(self, model: _Optional[_Union[Model, _Mapping]] = ...) -> None: ...

class ActivateModelRequest(_message.Message):
    __slots__ = ("version", "expected_version", "correlation_id")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_VERSION_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    version: str
    expected_version: str
    correlation_id: str
    def __init__(self, version: _Optional[str] = ..., expected_version: _Optional[str] = ..., correlation_id: _Optional[str] = ...) -> None: ...

class ActivateModelReply(_message.Message):
    __slots__ = ("model_version", "previous_version")
    MODEL_VERSION_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_VERSION_FIELD_NUMBER: _ClassVar[int]
    model_version: str
    previous_version: str
    def __init__(self, model_version: _Optional[str] = ..., previous_version: _Optional[str] = ...) -> None: ...

class PinModelRequest(_message.Message):
    __slots__ = ("version", "pinned", "correlation_id")
    VERSION_FIELD_NUMBER: _ClassVar[int]
    PINNED_FIELD_NUMBER: _ClassVar[int]
    CORRELATION_ID_FIELD_NUMBER: _ClassVar[int]
    version: str
    pinned: bool
    correlation_id: str
    def __init__(self, version: _Optional[str] = ..., pinned: bool = ..., correlation_id: _Optional[str] = ...) -> None: ...

class PinModelReply(_message.Message):
    __slots__ = ("model",)
    MODEL_FIELD_NUMBER: _ClassVar[int]
    model: Model
    def __init__(self, model: _Optional[_Union[Model, _Mapping]] = ...) -> None: ...

class ListModelsReply(_message.Message):
    __slots__ = ("models",)
    MODELS_FIELD_NUMBER: _ClassVar[int]
    models: _containers.RepeatedCompositeFieldContainer[Model]
    def __init__(self, models: _Optional[_Iterable[_Union[Model, _Mapping]]] = ...) -> None: ...

class ErrorDetail(_message.Message):
    __slots__ = ("kind", "thing", "got", "wanted", "reason", "recalibration_due")
    KIND_FIELD_NUMBER: _ClassVar[int]
    THING_FIELD_NUMBER: _ClassVar[int]
    GOT_FIELD_NUMBER: _ClassVar[int]
    WANTED_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    RECALIBRATION_DUE_FIELD_NUMBER: _ClassVar[int]
    kind: str
    thing: str
    got: str
    wanted: str
    reason: LossReason
    recalibration_due: bool
    def __init__(self, kind: _Optional[str] = ..., thing: _Optional[str] = ..., got: _Optional[str] = ..., wanted: _Optional[str] = ..., reason: _Optional[_Union[LossReason, str]] = ..., recalibration_due: bool = ...) -> None: ...
