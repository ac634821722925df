"""All that answers calls, and what the service says of itself."""

from importlib.metadata import version as installed_version

from lightpage.runtime.client.pb.lightpage.v1 import lightpage_pb2 as pb
from lightpage.runtime.client.wire.messages import message_of
from lightpage.runtime.client.wire.status import without_folders
from lightpage.runtime.service.caller import Call, Role
from lightpage.runtime.service.dataplane import DataPlane
from lightpage.runtime.service.display.display_calls import DisplayCalls
from lightpage.runtime.service.frames.frame_calls import FrameCalls
from lightpage.runtime.service.jobs.job_calls import JobCalls
from lightpage.runtime.service.jobs.recalibrator import Recalibrator
from lightpage.runtime.service.models.model_calls import ModelCalls, model_message
from lightpage.runtime.service.pages.page_calls import PageCalls
from lightpage.runtime.service.rpc import rpc


def handlers(plane: DataPlane, recalibrator: Recalibrator) -> tuple[object, ...]:
    """Objects whose methods are named as the RPCs that they answer; see `server.dispatcher`."""
    return (
        Describing(plane),
        FrameCalls(plane),
        PageCalls(plane),
        DisplayCalls(plane),
        ModelCalls(plane.models, plane.limits, plane.uploads),
        JobCalls(plane, recalibrator),
    )


class Describing:
    """Handler of Describe.

    Args:
        plane: what is described.
    """

    def __init__(self, plane: DataPlane) -> None:
        self._plane = plane

    @rpc(Role.READ)
    def Describe(self, request: pb.DescribeRequest, call: Call) -> pb.DescribeReply:
        """Return what the service is."""
        plane, model = self._plane, self._plane.models.current
        bundle, limits = model.decoder.bundle, self._plane.limits
        shared_bytes = 0 if plane.shared is None else plane.shared.most_bytes
        (rows_px, columns_px), (rows, columns) = bundle.profile.frame_shape, bundle.profile.page_shape
        return message_of(
            pb.DescribeReply,
            service_version=installed_version("lightpage"),
            model=model_message(plane.models.entry(bundle.manifest)),
            camera=message_of(
                pb.Camera,
                rows_px=rows_px,
                columns_px=columns_px,
                bit_depth=bundle.manifest.camera_bit_depth,
                pixel_type=bundle.manifest.frame_dtype,
            ),
            page=pb.PageShape(rows=rows, columns=columns),
            limits=message_of(pb.Limits, limits, shared_bytes=shared_bytes),
            source=without_folders(plane.source.name) if plane.has_source else "",
            source_levels=plane.source.levels if plane.has_source else 0,
            default_levels=plane.default_levels,
            profile_toml=bundle.manifest.profile,
            calibration_toml=bundle.manifest.calibration,
            pilot_mask=bundle.pilot_mask,
            code_toml=bundle.manifest.code,
            user_bytes_per_page=0 if bundle.code is None else model.decoder.page_codec.user_bytes,
            pilot_phases=bundle.pilot_phases,
            steps_s=plane.steps_s(),
        )
