"""PoCL's compiler works on processors that are newer than it."""

import ctypes
import subprocess
import sys
from types import SimpleNamespace

import pytest

from wavequake.kernels.device.pocl_processor import known_processor, name_processor

ZEN5 = "fma avx avx2 bmi1 bmi2 f16c abm movbe adx aes clflushopt clzero pclmulqdq rdseed sha_ni sse4a vaes"
HASWELL = "cx16 popcnt sse4_1 sse4_2 ssse3 avx avx2 bmi1 bmi2 f16c fma abm movbe"


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        (ZEN5, "znver3"),
        (HASWELL, "x86-64-v3"),
        ("cx16 popcnt sse4_1 sse4_2 ssse3 avx", "x86-64-v2"),
        ("sse2", "x86-64"),
    ],
)
def test_the_newest_known_processor_has_no_instruction_that_the_machine_lacks(tmp_path, flags, name):
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"model name\t: whatever\nflags\t\t: fpu {flags}\n")
    assert known_processor(cpuinfo) == name


def test_without_a_list_of_instructions_the_oldest_is_named(tmp_path):
    assert known_processor(tmp_path / "none") == "x86-64"


def test_known_processors_are_left_alone():
    assert not name_processor(
        SimpleNamespace(version="OpenCL 3.0 PoCL HSTR: pthread-x86_64-znver3", int_ptr=0)
    )


def test_a_record_without_the_name_is_left_alone():
    record = bytearray(4096)
    start = ctypes.addressof((ctypes.c_char * 4096).from_buffer(record))
    device = SimpleNamespace(version="OpenCL 3.0 PoCL HSTR: pthread-x86_64-generic", int_ptr=start)
    assert not name_processor(device)
    assert not any(record)


def test_the_name_is_replaced_where_it_stands():
    text = ctypes.create_string_buffer(b"generic")
    record = (ctypes.c_uint64 * 256)()
    record[3], record[80] = 12345, ctypes.addressof(text)
    device = SimpleNamespace(
        version="OpenCL 3.0 PoCL HSTR: pthread-x86_64-generic", int_ptr=ctypes.addressof(record)
    )
    assert name_processor(device, "x86-64-v3")
    assert ctypes.string_at(record[80]) == b"x86-64-v3"
    assert record[3] == 12345
    assert text.value == b"generic"


PROGRAM = """
import pyopencl as cl
from wavequake.kernels.device import opencl
handle = next((h for d, h in opencl._found() if d.platform == opencl.POCL), None)
if handle is None:
    raise SystemExit("none")
opencl.ensure_linker()
cl.Program(cl.Context([handle]), "__kernel void f(__global double *a) { a[get_global_id(0)] += 1; }").build()
"""


def test_pocl_builds_programs_on_this_machine():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    if done.stderr.strip() == "none":
        pytest.skip("PoCL is not installed")
    assert done.returncode == 0, done.stderr
