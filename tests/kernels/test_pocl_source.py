import numpy as np
import pytest

from wavequake.kernels.device import program
from wavequake.kernels.device.devices import NUMPY, POCL, list_devices
from wavequake.kernels.device.pocl_source import for_pocl, has_wide_vectors
from wavequake.kernels.transforms.fourier import fourier_2d

KERNEL = """
#define TWICE(a) (2.0 * (a))
__kernel void scale(const int count, __global const double *x,
#if SHIFTED
                    __global const double *shift, const double by,
#endif
                    __global double *y)
{
    __local double kept[4];
    const int i = get_global_id(1);
    if (i < count) {
        kept[0] = TWICE(x[i]);
        y[i] = kept[0];
#if SHIFTED
        y[i] += by * shift[i];
#endif
    }
}
"""


def test_a_kernel_calls_a_function_that_knows_its_place_by_its_arguments():
    text = for_pocl(KERNEL, wide=False)
    work, kernel = text.split("__kernel ")
    assert "void scale_work(" in work
    assert "noinline" in work
    assert "get_global_id" not in work
    assert "kept[0] = TWICE(x[i]);" in work
    assert "__local double kept[4];" in kernel
    assert "TWICE" not in kernel
    assert text.count("#if SHIFTED") == KERNEL.count("#if SHIFTED") + 2  # its parameters and the call


def test_only_wide_kernels_ask_for_instructions():
    assert "avx512" not in for_pocl(KERNEL, wide=False)
    wide = for_pocl(KERNEL, wide=True)
    assert wide.index("avx512f") < wide.index("scale_work") < wide.index("attribute pop")


@pytest.mark.parametrize("shifted", [0, 1])
@pytest.mark.parametrize("wide", [False, has_wide_vectors()])
def test_rewritten_kernels_compute_what_was_written(shifted, wide):
    cl = pytest.importorskip("pyopencl", reason="pyopencl is not installed")
    device = next((d for d in list_devices() if d.platform == POCL), None)
    if device is None:
        pytest.skip("PoCL is not installed (pip install pocl-binary-distribution)")
    queue = program._queue(device)
    built = cl.Program(queue.context, for_pocl(KERNEL, wide)).build([f"-DSHIFTED={shifted}"])
    x, shift, y = (program.aligned_empty((100,)) for _ in range(3))
    x[:], shift[:], y[:] = np.arange(100), np.linspace(0, 1, 100), np.nan
    share = cl.mem_flags.USE_HOST_PTR
    buffers = [cl.Buffer(queue.context, cl.mem_flags.READ_WRITE | share, hostbuf=a) for a in (x, shift, y)]
    middle = [buffers[1], np.float64(3.0)] if shifted else []
    built.scale(queue, (1, 128, 1), (1, 32, 1), np.int32(100), buffers[0], *middle, buffers[2])
    queue.finish()
    assert np.array_equal(y, 2 * x + (3 * shift if shifted else 0))


@pytest.mark.parametrize(
    ("flags", "wide"),
    [
        ("fpu avx2 fma avx512f avx512dq avx512cd avx512bw avx512vl avx512_bf16", True),
        (
            "fpu avx2 fma avx512f avx512cd avx512er avx512pf",
            False,
        ),  # the first with 512 bits: Knights Landing
        ("fpu avx2 fma", False),
    ],
)
def test_what_a_processor_can_do_is_what_linux_tells(tmp_path, flags, wide):
    file = tmp_path / "cpuinfo"
    file.write_text(
        f"processor\t: 0\nmodel name\t: A\nflags\t\t: {flags}\nbugs\t\t: avx512f\n\nprocessor\t: 1\n"
    )
    assert has_wide_vectors(file) is wide


def test_other_systems_are_not_asked_for_wide_vectors(tmp_path):
    assert not has_wide_vectors(tmp_path / "none")
    (tmp_path / "empty").write_text("Features : asimd\n")
    assert not has_wide_vectors(tmp_path / "empty")


def test_all_of_the_package_s_kernels_are_rewritten():
    for name in ("segmented", "strehl", "folded_transform", "fourier"):
        text = program.source(f"{name}.cl")
        assert for_pocl(text, wide=False).count("_work(") == 2 * text.count("__kernel ")


def test_transforms_with_memory_of_a_work_group_survive():
    device = next((d for d in list_devices() if d.platform == POCL), NUMPY)
    values = np.random.default_rng(0).normal(size=(2, 64, 128)) + 0j
    engine = "opencl" if device is not NUMPY else "scipy"
    assert np.allclose(fourier_2d(values, device=device, engine=engine), np.fft.fft2(values), atol=1e-11)
