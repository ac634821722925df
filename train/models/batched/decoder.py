"""The whole decoder for many pages: frames and constants of a device to p."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn import functional

from lightpage.train.models.batched.branches import BatchedBranches
from lightpage.train.models.batched.field import BatchedField, Seen
from lightpage.train.models.batched.frames import BatchedFrames
from lightpage.train.models.batched.products import Tables, padded, sizes, turned_product
from lightpage.train.models.batched.waves import BatchedWaves, of_part
from lightpage.train.models.decoder import SymbolDecoder
from lightpage.train.models.field import FieldRecovery
from lightpage.train.models.localizers.wave import WaveLocalizer
from lightpage.train.models.network import Refiner, SymbolUNet, estimate
from lightpage.train.models.parts import Parts
from lightpage.train.models.prediction import Prediction, expected_phasors
from lightpage.train.models.waves import Waves

PLACES = "where"
"""In the names of constants that are places, which stay in float32."""


class BatchedDecoder(nn.Module):
    """A `SymbolDecoder` with its field recovery for B pages.

    Args:
        recovery: of the decoder's choices, for cameras that see the same plane.
        decoder: trained.
        bits: of a frame's type.
        dtype: in which all is computed but places, and the last step to p.
    """

    def __init__(self, recovery: FieldRecovery, decoder: SymbolDecoder, bits: int, dtype: torch.dtype) -> None:
        super().__init__()
        self.dtype = dtype
        self.frames = BatchedFrames(recovery, bits, dtype)
        self.field = BatchedField(recovery)
        self.network = Features(decoder.network, dtype)
        localizer = decoder.localizer
        self.way: WaysBack | BatchedBranches = (
            WaysBack(localizer.waves) if isinstance(localizer, WaveLocalizer) else BatchedBranches(localizer)
        )
        self.prediction = None if decoder.prediction is None else Unexplained(decoder.prediction)
        self.refiners = nn.ModuleList(
            BatchedRefiner(refiner, dtype) for refiner in decoder.refiners if isinstance(refiner, Refiner)
        )
        self.inputs = decoder.table_inputs

    def tables(self, table: Tables) -> Tables:
        """Constants of a device's table: its references, registration, homodyne and the decoder's own inputs."""
        recovery = self.field.recovery
        blocks = recovery.in_blocks(table["reference_in_phase"], table["reference_quadrature"])
        seen = recovery.references(blocks, table["registration"])
        parts: dict[str, Tables] = {
            "frames": self.frames.tables(blocks, seen),
            "field": self.field.tables(seen, table["homodyne"]),
        }
        if isinstance(self.way, WaysBack):
            parts["way"] = self.way.tables(table["parameters"])
        else:
            parts["way"] = self.way.tables(table["places"], table["place_gradients"], table["phases"])
        networks = {"network": self.network} | {f"refiner_{n}": one.network for n, one in enumerate(self._refining())}
        for name, network in networks.items():
            parts[name] = network.tables(table["positions"])
        if self.prediction is not None:
            parts["prediction"] = self.prediction.tables(table["parameters"])
        else:
            del parts["field"]["lit"]
        made = {f"{part}.{name}": value for part, values in parts.items() for name, value in values.items()}
        return {name: value.to(self.table_type(name)) for name, value in made.items()}

    def table_type(self, name: str) -> torch.dtype:
        """Return the type in which a constant is held."""
        return torch.float32 if PLACES in name else self.dtype

    def forward(self, in_phase: Tensor, quadrature: Tensor, shift: Tensor, tables: Tables) -> tuple[Tensor, Tensor]:
        """Frames of B pages to p, by constants of a device.

        Args:
            in_phase, quadrature: [B, H, W].
            shift: of either camera's image against the registration of the constants, pixels, [B, 2, 2] float32.
            tables: constants.

        Returns:
            p [B, 2, ny, nx], and what is left of the equations over the field [B], float32.
        """
        own = {part: of_part(tables, part) for part in ("frames", "field", "way", "network", "prediction")}
        cameras = enumerate((in_phase, quadrature))
        seen = Seen(*(self.frames(each, shift[:, camera], own["frames"], camera) for camera, each in cameras))
        field = self.field(seen, own["field"])
        power = self.field.power(field)
        residual = self.field.residual(seen, field, power, own["field"])
        light = self.way(field, own["way"]) if isinstance(self.way, WaysBack) else self.way(field, power, own["way"])
        p = estimate(self.network(light, own["network"]))
        for number, refiner in enumerate(self._refining()):
            assert self.prediction is not None
            light = self.prediction(self.field, seen, field, p, own["prediction"], own["field"])
            p = refiner(light, p, of_part(tables, f"refiner_{number}"))
        return p, residual

    def _refining(self) -> list[BatchedRefiner]:
        return [refiner for refiner in self.refiners if isinstance(refiner, BatchedRefiner)]


class WaysThere(nn.Module):
    """Pages on the modulator to the common grid.

    Args:
        waves: of one page.
    """

    def __init__(self, waves: Waves) -> None:
        super().__init__()
        self.waves = BatchedWaves(waves, to_page=False)
        down, across = waves.interpolations
        self.down: Tensor
        self.across: Tensor
        self.register_buffer("down", torch.from_numpy(down).float(), persistent=False)
        self.register_buffer("across", torch.from_numpy(across).float(), persistent=False)

    def tables(self, parameters: Tensor, blur: Tensor | float = 0.0) -> Tables:
        """Constants of a device; the arguments are those of `BatchedWaves.tables`."""
        made = self.waves.tables(parameters, blur)
        page, camera = self.waves.first, self.waves.last
        for axis, count, grid in zip("yx", page.shape, (self.down, self.across), strict=True):
            made[f"page_{axis}"] = page.laid_out(torch.eye(count, device=grid.device), axis)
            made[f"up_{axis}"] = padded(camera.laid_out(grid, axis), -2).transpose(-1, -2)
        return made

    def forward(self, page: Tensor, tables: Tables) -> Tensor:
        """Pages [B, 2, ny, nx] to the sparse samples of the common grid, as the lens has them."""
        laid_out = turned_product(turned_product(page, tables["page_y"]), tables["page_x"])
        return torch.as_tensor(self.waves(laid_out, tables))

    @staticmethod
    def on_grid(sparse: Tensor, tables: Tables) -> Parts:
        """A field on the sparse samples to the common grid, real and imaginary part, [B, ny, nx] of whole multiples."""
        real, imaginary = (
            turned_product(turned_product(sparse[:, part], tables["up_y"]), tables["up_x"]) for part in (0, 1)
        )
        return real, imaginary


class WaysBack(nn.Module):
    """A field on the common grid back to the modulator, as features at symbol pitch.

    Args:
        waves: of one page.
    """

    def __init__(self, waves: Waves) -> None:
        super().__init__()
        self.waves = BatchedWaves(waves, to_page=True)
        self.samples = waves.samples
        down, across = waves.interpolations
        self.down: Tensor
        self.across: Tensor
        self.register_buffer("down", torch.from_numpy(down).float(), persistent=False)
        self.register_buffer("across", torch.from_numpy(across).float(), persistent=False)

    def tables(self, parameters: Tensor, blur: Tensor | float = 0.0) -> Tables:
        """Constants of a device; the arguments are those of `BatchedWaves.tables`."""
        lens = self.waves.first
        down, across = lens.laid_out(self.down, "y"), lens.laid_out(self.across, "x")
        return {"down": padded(down, -2), "across": padded(across, -2)} | self.waves.tables(parameters, blur)

    def forward(self, field: Parts, tables: Tables) -> Tensor:
        """E, [B, ny, nx] each of whole multiples, to [B, 2 S, ny, nx] over the light's root mean square."""
        page = self.waves.last.cropped(self.waves(self.sparse(field, tables), tables))
        rows, columns = (count // self.samples for count in sizes(page)[-2:])
        scale = torch.rsqrt(_mean_square(page) * 2 + 1e-12).to(page.dtype)[:, None, None, None]
        split = (page * scale).reshape(-1, 2, rows, self.samples, columns, self.samples)
        return split.permute(0, 1, 3, 5, 2, 4).reshape(-1, 2 * self.samples**2, rows, columns)

    @staticmethod
    def sparse(field: Parts, tables: Tables) -> Tensor:
        """A field on the common grid, by the adjoint of interpolation, on its sparse samples as the lens has them."""
        return torch.stack(
            [turned_product(turned_product(part, tables["down"]), tables["across"]) for part in field], 1
        )


class Features(nn.Module):
    """A `SymbolUNet` whose scales and shifts by place are constants.

    Args:
        network: trained.
        dtype: in which it is computed.
    """

    def __init__(self, network: SymbolUNet, dtype: torch.dtype) -> None:
        super().__init__()
        self.where, self.bias = network.where, network.stem.bias
        self.unet = copy.deepcopy(network).to(dtype)

    def tables(self, positions: Tensor) -> Tables:
        """Constants of exit centroids [2, ny, nx]."""
        scale, shift = self.where.of_places(positions[None])
        assert self.bias is not None
        return {"scale": scale, "shift": shift + scale * self.bias[:, None, None]}

    def forward(self, light: Tensor, tables: Tables) -> Tensor:
        """Outputs of the network, float32 [B, 3, ny, nx]."""
        stem = functional.conv2d(light, self.unet.stem.weight, padding=self.unet.stem.padding)
        placed = stem * tables["scale"] + tables["shift"]
        return self.unet.behind_places(placed).to(torch.float32)


class Unexplained(nn.Module):
    """A `Prediction` for many pages.

    Args:
        prediction: of one page, fitted.
    """

    def __init__(self, prediction: Prediction) -> None:
        super().__init__()
        self.there = WaysThere(prediction.waves)
        self.back = WaysBack(prediction.back)
        self.floor = prediction.floor
        illumination = torch.tensordot(prediction.illumination, torch.stack(prediction.terms()), 1)
        self.illumination: Tensor
        self.register_buffer("illumination", illumination[None], persistent=False)

    def tables(self, parameters: Tensor) -> Tables:
        """Constants of a device."""
        there, back = self.there.tables(parameters), self.back.tables(parameters)
        made = {f"there.{name}": value for name, value in there.items()}
        made |= {f"back.{name}": value for name, value in back.items()}
        return made | {"illumination": self.illumination, "floor": self.floor}

    def forward(
        self, solver: BatchedField, seen: Seen, field: Parts, p: Tensor, tables: Tables, of_field: Tables
    ) -> Tensor:
        """Light that estimated pages p [B, 2, ny, nx] leave unexplained, [B, 2 S, ny, nx]."""
        dtype, back, there = field[0].dtype, of_part(tables, "back"), of_part(tables, "there")
        written = expected_phasors(p, 1).to(dtype)
        expected = self.there(_multiplied(written, tables["illumination"]), there)  # on the sparse samples
        planes = self.there.on_grid(expected, there)
        # sums over the grid: beyond it there are sparse samples too, but known light has none there
        turned = _multiplied(self.back.sparse(field, back), torch.cat([expected[:, :1], -expected[:, 1:]], 1))
        rows, columns = sizes(turned)[-2:]
        both = (turned @ turned.new_full((columns, 8), 1 / columns))[..., 0].to(torch.float32).mean(-1)
        ny, nx = solver.recovery.grid.shape
        share = rows * columns / (2 * ny * nx)
        real, imaginary = (share * both / (solver.power(planes) + 1e-12)[:, None]).to(dtype).unbind(1)
        a, b = real[:, None, None], imaginary[:, None, None]
        scaled = a * planes[0] - b * planes[1], a * planes[1] + b * planes[0]
        left = solver.innovation(seen, scaled, of_field, tables["floor"])
        return torch.as_tensor(self.back(left, back))


class BatchedRefiner(nn.Module):
    """A `Refiner` for many pages.

    Args:
        refiner: trained.
        dtype: in which its network is computed.
    """

    def __init__(self, refiner: Refiner, dtype: torch.dtype) -> None:
        super().__init__()
        self.refiner, self.dtype = refiner, dtype
        self.network = Features(refiner.unet, dtype)

    def forward(self, light: Tensor, earlier: Tensor, tables: Tables) -> Tensor:
        """Unexplained light and the earlier p to p, [B, 2, ny, nx] float32."""
        known = torch.cat([light, *(one.to(self.dtype) for one in self.refiner.known(earlier))], 1)
        return estimate(self.network(known, tables), self.refiner.trust * earlier)


def _multiplied(one: Tensor, other: Tensor) -> Tensor:
    """Product of complex numbers, real and imaginary parts [B, 2, ...]."""
    (a, b), (c, d) = one.unbind(1), other.unbind(1)
    return torch.stack([a * c - b * d, a * d + b * c], 1)


def _mean_square(light: Tensor) -> Tensor:
    """Mean square of [B, 2, ny, nx] over all but the first axis, [B] float32: sums of rows are products."""
    ones = light.new_full((sizes(light)[-1], 8), 1 / sizes(light)[-1])
    return ((light * light) @ ones)[..., 0].to(torch.float32).mean((1, 2))
