import subprocess

from wavequake.kernels.devices import NUMPY, choose_device, list_devices
from wavequake.workflows import provenance


def test_provenance_names_software_and_machine():
    found = provenance.collect(NUMPY)
    assert all(isinstance(value, str) for value in found.values())
    assert "numpy 2" in found["packages"]
    assert "blas" in found["blas"].lower()
    assert found["cpu"]
    assert found["opencl"] == ""


def test_provenance_names_the_opencl_driver():
    device = choose_device("auto") if len(list_devices()) > 1 else NUMPY
    assert device.name in provenance.collect(device)["opencl"] or device is NUMPY


def test_commit_is_that_of_the_checkout_that_tracks_the_package(tmp_path):
    def git(*words):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", *identity, *words], cwd=tmp_path, check=True, capture_output=True)

    assert provenance.git_commit(tmp_path) == ""
    git("init")
    (tmp_path / "__init__.py").write_text("")
    assert provenance.git_commit(tmp_path) == ""  # installed inside somebody else's repository
    git("add", "__init__.py")
    git("commit", "-m", "a")
    commit = provenance.git_commit(tmp_path)
    assert len(commit) == 40
    (tmp_path / "__init__.py").write_text("1")
    assert provenance.git_commit(tmp_path) == f"{commit}-dirty"
