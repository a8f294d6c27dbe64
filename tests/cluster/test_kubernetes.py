"""The manifests against the JSON schemas that Kubernetes publishes of its API, old and new."""

import pytest
import yaml

from wavequake.cluster.local import SETTINGS, THREADS
from wavequake.cluster.places import KUBERNETES
from wavequake.files import folder

schema = pytest.importorskip("kubernetes_validate", reason="needs: pip install kubernetes-validate")

VERSIONS = ("1.27", "1.31", "1.35")


def manifests():
    return [
        entry
        for name in ("kubernetes.yaml", "kubernetes-run.yaml")
        for entry in yaml.safe_load_all((folder("cluster") / name).read_text())
    ]


def check(manifest, version=VERSIONS[-1]):
    """Raise ValidationError if a key is unknown or missing, or a value does not fit its type."""
    schema.validate(manifest, version, strict=True)


def by(kind, role=None):
    return next(
        one
        for one in manifests()
        if one["kind"] == kind and role in (None, one["metadata"]["labels"].get("role"))
    )


def container(one):
    return one["spec"]["template"]["spec"]["containers"][0]


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("manifest", manifests(), ids=lambda one: f"{one['kind']}-{one['metadata']['name']}")
def test_a_manifest_fits_the_schema(manifest, version):
    check(manifest, version)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda one: one["spec"].update(replica=3), "'replica' was unexpected"),
        (lambda one: one["spec"].pop("selector"), "'selector' is a required property"),
        (lambda one: one["spec"].update(replicas="two"), "'two' is not of type 'integer'"),
        (lambda one: container(one)["env"][0].update(value=1), "1 is not of type 'string'"),
    ],
)
def test_the_check_finds_what_does_not_fit(change, words):
    manifest = by("Deployment", "worker")
    change(manifest)
    with pytest.raises(schema.ValidationError, match=words):
        check(manifest)


def test_labels_volumes_and_names_belong_together():
    service, scheduler, worker = by("Service"), by("Deployment", "scheduler"), by("Deployment", "worker")
    address = f"tcp://{service['metadata']['name']}:{service['spec']['ports'][0]['port']}"
    assert address == KUBERNETES
    assert address in container(worker)["command"]
    for one in (scheduler, worker):
        labels = one["spec"]["template"]["metadata"]["labels"]
        assert one["spec"]["selector"]["matchLabels"].items() <= labels.items()
    assert service["spec"]["selector"].items() <= scheduler["spec"]["template"]["metadata"]["labels"].items()
    claim = by("PersistentVolumeClaim")["metadata"]["name"]
    for one in (worker, by("Job")):
        pod = one["spec"]["template"]["spec"]
        volumes = {volume["name"]: volume["persistentVolumeClaim"]["claimName"] for volume in pod["volumes"]}
        mounts = container(one)["volumeMounts"]
        assert {mount["mountPath"]: volumes[mount["name"]] for mount in mounts} == {"/stores": claim}


def test_workers_have_one_thread_and_the_scheduler_our_settings():
    threads = {entry["name"]: entry["value"] for entry in container(by("Deployment", "worker"))["env"]}
    assert threads == THREADS
    for entry in container(by("Deployment", "scheduler"))["env"]:
        key = entry["name"].removeprefix("DASK_").lower().replace("__", ".").replace("_", "-")
        assert str(SETTINGS[key]) == entry["value"]
