"""A device that computes images, transforms or Strehl ratios unlike NumPy's is refused at the first batch."""

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.imaging.engines.segment_lattice import lattice_psf, segment_lattice
from wavequake.kernels.device import first_batch
from wavequake.kernels.device.devices import list_devices
from wavequake.kernels.device.program import source
from wavequake.kernels.sums import strehl
from wavequake.kernels.transforms import folded as folded_transform
from wavequake.kernels.transforms import fourier, lattice
from wavequake.kernels.transforms.folded_pupils import LitPhase, Rim, SmoothPhase
from wavequake.optics.segments.layout import hexagon_ring_segments

CPUS = [device for device in list_devices() if device.kind == "cpu"]
DEVICES = pytest.mark.parametrize("device", CPUS, ids=lambda device: device.name)
RANDOM = np.random.default_rng(7)
_RING = hexagon_ring_segments(700.0, 2, 5.0)


@pytest.fixture(autouse=True)
def nothing_trusted(monkeypatch):
    monkeypatch.setattr(first_batch, "_TRUSTED", set())


def larger(outputs):
    for out in outputs.values():
        out *= 1.5


def lost(outputs):
    for out in outputs.values():
        out.fill(np.nan)


def dark(outputs):
    for out in outputs.values():
        out.fill(0.0)


def mirrored(outputs):
    for out in outputs.values():
        out[...] = np.flip(out, min(1, out.ndim - 1)).copy()


def spoil(monkeypatch, module, how):
    """Let what a module's launches write go wrong."""
    real = module.run_steps

    def wrong(device, steps, inputs, outputs, scratch):
        real(device, steps, inputs, outputs, scratch)
        how(outputs)

    monkeypatch.setattr(module, "run_steps", wrong)


def check(monkeypatch, module, call, ways):
    """A call is refused in each way to go wrong, and passes, once compared, when it is right again."""
    real = module.run_steps
    for how in ways:
        spoil(monkeypatch, module, how)
        with pytest.raises(UserError, match="computes wrong numbers"):
            call()
        assert not first_batch._TRUSTED
        monkeypatch.setattr(module, "run_steps", real)
    call()
    assert first_batch._TRUSTED
    spoil(monkeypatch, module, larger)
    call()  # later batches are not compared
    monkeypatch.setattr(module, "run_steps", real)


def smooth(rows, columns):
    """A round pupil: few of the numbers of its transform are large."""
    y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
    return np.stack([(x**2 + y**2 < 0.2) * np.exp(1j * (x + 2 * y)), np.full((rows, columns), np.nan)])


@DEVICES
@pytest.mark.parametrize("inverse", [False, True])
@pytest.mark.parametrize("dtype", [np.complex64, np.complex128])
@pytest.mark.parametrize("size", [1e-12, 1e12])
def test_transforms(device, monkeypatch, dtype, inverse, size):
    values = (size * smooth(64, 64)).astype(dtype)
    for given in (values, values[::-1]):
        first_batch._TRUSTED.clear()
        ways = (larger, dark, lost, mirrored)
        check(monkeypatch, fourier, lambda g=given: fourier.fourier_2d(g, inverse, device, "opencl"), ways)


@DEVICES
def test_a_transform_of_another_sign_is_refused(device, monkeypatch):
    values = RANDOM.normal(size=(1, 45, 60)) + 1j
    real = fourier._plan
    monkeypatch.setattr(fourier, "_plan", lambda *given: real(*given[:3], not given[3], given[4]))
    with pytest.raises(UserError, match="of 16 rows of the image of the first batch 16 differ"):
        fourier.fourier_2d(values, device=device, engine="opencl")
    monkeypatch.setattr(fourier, "_plan", real)
    fourier.fourier_2d(0.0 * values, device=device, engine="opencl")
    assert not first_batch._TRUSTED  # nothing to compare yet
    fourier.fourier_2d(values, device=device, engine="opencl")
    assert first_batch._TRUSTED


def pupil_kinds():
    """Amplitude, pupils and rim of each kind; the first pupil has a phase that is not known."""
    amplitude = (np.hypot(*np.mgrid[-1:1:24j, -1:1:24j]) < 0.9) * 1.0
    phase = RANDOM.normal(0.0, 1.0, (4, 24, 24))
    phase[0, 12, 12] = np.nan
    rim = Rim(np.array([30, 400, 30]), np.array([0.5, 0.2, 0.3]))
    smooth = SmoothPhase(RANDOM.normal(0.0, 1.0, (4, 5, 5)), RANDOM.normal(0.0, 1.0, (4, 3)))
    smooth.rim[0, 1] = np.nan
    starts = 24 * np.repeat(np.arange(24, dtype=np.int32)[:, None], 2, axis=1)
    dark = np.where(amplitude != 0.0, phase, np.inf)
    return {
        "phases": (amplitude, phase, None),
        "dark": (amplitude, dark[1:], None),
        "fields": (amplitude, amplitude * np.exp(1j * phase), None),
        "lit": (amplitude, LitPhase(phase.reshape(4, -1), starts), None),
        "smooth": (amplitude, smooth, rim),
    }


KINDS = pytest.mark.parametrize("kind", pupil_kinds())


@DEVICES
@KINDS
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_folded_images(device, monkeypatch, dtype, kind):
    amplitude, pupils, rim = pupil_kinds()[kind]
    transform = folded_transform.folded_transform(amplitude, 21, 0.4, 1e-9, device, dtype, rim)
    ways = (larger, dark, lost, mirrored)
    check(monkeypatch, folded_transform, lambda: folded_transform.folded_images(transform, pupils), ways)


@DEVICES
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_folded_sums(device, monkeypatch, dtype):
    amplitude, pupils, rim = pupil_kinds()["smooth"]
    transform = folded_transform.folded_transform(amplitude, 21, 0.4, 1e-9, device, dtype, rim)
    weights, none = np.array([0.0, 1e-3, 2e-3, 3e-3]), np.zeros((21, 21))
    folded_transform.folded_sum(transform, pupils, 0.0 * weights, none)
    assert not first_batch._TRUSTED  # nothing to compare yet
    for unknown in (np.nan, np.inf):
        folded_transform.folded_sum(transform, pupils, unknown + weights, none)
    assert len(first_batch._TRUSTED) == 1  # images alone
    first_batch._TRUSTED.clear()
    real = folded_transform.run_steps

    def spoiled(how):
        def only_sums(device, steps, inputs, outputs, scratch):
            real(device, steps, inputs, outputs, scratch)
            if "after" in outputs:
                outputs["after"][...] = how(outputs["after"])

        return only_sums

    for how in (lambda sums: 1.5 * sums, lambda sums: 0.0 * sums, lambda sums: sums[::-1].copy()):
        monkeypatch.setattr(folded_transform, "run_steps", spoiled(how))
        with pytest.raises(UserError, match="rows of the image of the first batch"):
            folded_transform.folded_sum(transform, pupils, weights, none)
        monkeypatch.setattr(folded_transform, "run_steps", real)
        assert len(first_batch._TRUSTED) == 1  # the images
    folded_transform.folded_sum(transform, pupils, weights, none + 1.0)
    assert len(first_batch._TRUSTED) == 2


@DEVICES
@KINDS
def test_a_program_of_another_sign_is_refused(device, monkeypatch, kind):
    amplitude, pupils, rim = pupil_kinds()[kind]
    transform = folded_transform.folded_transform(amplitude, 20, 0.4, 1e-9, device, "float32", rim)
    right = folded_transform._text()
    text = right.replace("part[0] - part[6]", "part[0] + part[6]")
    assert text != right
    monkeypatch.setattr(folded_transform, "_text", lambda: text)
    with pytest.raises(UserError, match="of 16 rows of the image of the first batch 16 differ"):
        folded_transform.folded_images(transform, pupils)


@DEVICES
@pytest.mark.parametrize("patches", [1, 37, 200])
def test_strehl_ratios(device, monkeypatch, patches):
    phase = RANDOM.normal(0.0, 1.0, (40, patches))
    phase[:3, 0] = np.nan
    ways = (larger, dark, lost, mirrored) if patches > 1 else (larger, dark, lost)
    check(monkeypatch, strehl, lambda: strehl.strehl_ratios(phase, np.ones(patches), device), ways)


@DEVICES
def test_strehl_ratios_of_another_sign_are_refused(device, monkeypatch):
    phase = RANDOM.normal(0.0, 1.0, (3, 37))
    strehl.strehl_ratios(np.full((3, 37), np.nan), np.ones(37), device)
    strehl.strehl_ratios(phase[:0], np.ones(37), device)
    assert not first_batch._TRUSTED
    right = strehl._text()
    monkeypatch.setattr(strehl, "_text", lambda: right.replace("re + total_im", "re - total_im"))
    assert strehl._text() != right
    with pytest.raises(UserError, match="of 3 instants of the first batch 3 differ"):
        strehl.strehl_ratios(phase, np.ones(37), device)


@DEVICES
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("moments", [1, 6])
def test_lattices(device, monkeypatch, dtype, moments):
    corners, centers = _RING.corners, _RING.centers[:, :2]
    prepared = segment_lattice(corners, centers, 21, 0.3, 9000.0, dtype, device, moments)
    motion = RANDOM.normal(0.0, 1.0, (3, len(centers), 3)) * [0.2, 6e-5, 6e-5]
    motion[0, 2, 0] = np.nan
    if moments == 1:
        motion[2, :, 1:] = motion[1, :, 1:] = np.nan  # does not count
    lattice_psf(prepared, motion[:1])
    lattice_psf(prepared, motion[:0])
    assert not first_batch._TRUSTED  # nothing to compare yet
    real = lattice.launch

    def spoiled(how):
        def launch(device, name, constants, size, inputs, outputs, **more):
            real(device, name, constants, size, inputs, outputs, **more)
            how({"images": outputs[0]})

        return launch

    for how in (larger, dark, lost, mirrored):
        monkeypatch.setattr(lattice, "launch", spoiled(how))
        with pytest.raises(UserError, match="of 16 rows of the image of the first batch"):
            lattice_psf(prepared, motion)
        assert not first_batch._TRUSTED
    monkeypatch.setattr(lattice, "launch", real)
    if moments > 1:
        lattice_psf(prepared, 1e20 * motion[1:])
        assert not first_batch._TRUSTED  # beyond any series
    motion[1, :, 0] += 1e15
    lattice_psf(prepared, motion)
    assert first_batch._TRUSTED
    monkeypatch.setattr(lattice, "launch", spoiled(larger))
    lattice_psf(prepared, motion)  # later batches are not compared


@DEVICES
def test_a_lattice_of_another_sign_is_refused(device, monkeypatch):
    right = source("lattice.cl")
    text = right.replace("sums[0] - sums[6], b", "sums[0] + sums[6], b")
    assert text != right
    real = lattice.launch
    monkeypatch.setattr(lattice, "launch", lambda *given, **more: real(*given, text=text, **more))
    prepared = segment_lattice(_RING.corners, _RING.centers[:, :2], 21, 0.3, 9000.0, device=device)
    with pytest.raises(UserError, match="of 16 rows of the image of the first batch"):
        lattice_psf(prepared, RANDOM.normal(0.0, 0.2, (2, len(_RING.centers))))
