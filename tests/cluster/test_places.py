from pathlib import Path

import pytest
import yaml

from wavequake.cluster.local import THREADS
from wavequake.cluster.places import place_of
from wavequake.cluster.slurm import prologue
from wavequake.cluster.template import Slurm, Ssh, read_template
from wavequake.errors import UserError
from wavequake.files import folder


def written(tmp_path, text):
    (tmp_path / "cluster.yaml").write_text(text)
    return tmp_path / "cluster.yaml"


def test_the_bundled_slurm_file_is_what_the_code_asks_for_by_default():
    template = read_template(Slurm, folder("cluster") / "slurm.yaml")
    assert (template.interface, template.jobs, template.processes) == ("lo", 2, 2)
    text = (folder("cluster") / "slurm.yaml").read_text()
    commented = "\n".join(
        line.removeprefix("# ") for line in text.splitlines() if ": " in line and line[0] != " "
    )
    assert {key for key in Slurm.model_fields if f"{key}:" in commented} == set(Slurm.model_fields)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("jbos: 3", "unknown key 'jbos'; known are account, directives"),
        ("jobs: 0", r"jobs: .*greater than or equal to 1"),
        ("walltime: soon", "walltime: "),
        ("partition: 'a\n\n#SBATCH --uid=0'", "partition: "),
        ("partition: 'a; rm -rf /'", "partition: "),
        ("directives: ['--wrap=`id`']", r"directives\.0: "),
        ("directives: ['--mem=1 --wrap=x']", r"directives\.0: "),
        ("modules: ['gcc && id']", r"modules\.0: "),
        ("python: 'python $(id)'", "python: "),
        ("jobs: !!python/object/apply:os.system ['touch hacked']", "no plain YAML"),
        ("[1, 2]", "must hold keys and values"),
        ("", "must hold keys and values"),
        ("a: [", "no plain YAML"),
        ("tls: {ca: a}", r"tls\.certificate: Field required"),
    ],
)
def test_a_cluster_file_is_data_and_every_entry_has_its_form(tmp_path, monkeypatch, text, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=words):
        place_of("slurm", written(tmp_path, text))
    assert [file.name for file in tmp_path.iterdir()] == ["cluster.yaml"]


def test_a_job_sets_modules_and_one_thread_for_each_worker(tmp_path):
    lines = prologue(read_template(Slurm, written(tmp_path, "modules: [gcc/13, ocl]")))
    assert lines[:2] == ["module load gcc/13", "module load ocl"]
    assert {f"export {name}=1" for name in THREADS} < set(lines)
    assert "unset POCL_AFFINITY" in lines


@pytest.mark.parametrize(
    ("on", "text", "words"),
    [
        ("sulrm", None, "is unknown; use serial, local, slurm, ssh, kubernetes, or the tcp"),
        ("ssh", None, "needs --cluster FILE.yaml, which says at least"),
        ("tls://h:1", None, "needs --cluster FILE.yaml with the certificates"),
        ("tls://h:1", "{}", "needs --cluster FILE.yaml with the certificates"),
        ("local", "{}", "which --on local does not use"),
        ("ssh", "hosts: []", "hosts: "),
        ("ssh", "hosts: ['-oProxyCommand=id']", r"hosts\.0: "),
    ],
)
def test_a_place_that_cannot_be_is_one_sentence(tmp_path, on, text, words):
    with pytest.raises(UserError, match=words):
        place_of(on, None if text is None else written(tmp_path, text))


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.yaml cannot be read \(No such file"):
        place_of("slurm", tmp_path / "nowhere.yaml")


@pytest.mark.parametrize(
    ("on", "library", "words"),
    [
        ("slurm", "dask_jobqueue", "pip install dask-jobqueue"),
        ("ssh", "asyncssh", "pip install asyncssh"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, on, library, words):
    monkeypatch.setattr(f"wavequake.cluster.{on}.find_spec", lambda name: None if name == library else 1)
    place = place_of(on, written(tmp_path, "{}" if on == "slurm" else "hosts: [here]"))
    with pytest.raises(UserError, match=words), place(1, False):
        pass


def test_slurm_without_its_commands_is_one_sentence(monkeypatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    with pytest.raises(UserError, match="needs the command sbatch"), place_of("slurm")(1, False):
        pass


def test_nothing_listens_beyond_loopback_unless_told():
    assert read_template(Slurm, folder("cluster") / "slurm.yaml").interface == Slurm().interface == "lo"
    assert Ssh(hosts=("a",)).listen == "127.0.0.1"
    assert all(yaml.safe_load_all(file.read_text()) for file in Path(folder("cluster")).glob("*.yaml"))
