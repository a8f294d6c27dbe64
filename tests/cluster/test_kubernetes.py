"""The manifests against the models of Kubernetes' own client, which are made from its OpenAPI schema."""

import pytest
import yaml

from wavequake.cluster.local import SETTINGS, THREADS
from wavequake.cluster.places import KUBERNETES
from wavequake.files import folder

client = pytest.importorskip("kubernetes.client", reason="the schema needs: pip install kubernetes")

MODELS = {
    "PersistentVolumeClaim": "V1PersistentVolumeClaim",
    "Service": "V1Service",
    "Deployment": "V1Deployment",
    "NetworkPolicy": "V1NetworkPolicy",
    "Job": "V1Job",
}


def manifests():
    return [
        entry
        for name in ("kubernetes.yaml", "kubernetes-run.yaml")
        for entry in yaml.safe_load_all((folder("cluster") / name).read_text())
    ]


def check(manifest):
    """Raise ValueError if a key is unknown or missing, or a value does not fit its type in the schema."""
    getattr(client, MODELS[manifest["kind"]]).model_validate(manifest, extra="forbid")


def by(kind, role=None):
    return next(
        one
        for one in manifests()
        if one["kind"] == kind and role in (None, one["metadata"]["labels"].get("role"))
    )


def container(one):
    return one["spec"]["template"]["spec"]["containers"][0]


@pytest.mark.parametrize("manifest", manifests(), ids=lambda one: f"{one['kind']}-{one['metadata']['name']}")
def test_a_manifest_fits_the_schema(manifest):
    check(manifest)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda one: one["spec"].update(replica=3), r"spec\.replica\n +Extra inputs are not permitted"),
        (lambda one: one["spec"].pop("selector"), r"spec\.selector\n +Field required"),
        (
            lambda one: one["spec"].update(replicas="two"),
            r"spec\.replicas\n +Input should be a valid integer",
        ),
        (
            lambda one: container(one)["env"][0].update(value=1),
            r"env\.0\.value\n +Input should be a valid string",
        ),
    ],
)
def test_the_check_finds_what_does_not_fit(change, words):
    manifest = by("Deployment", "worker")
    change(manifest)
    with pytest.raises(ValueError, match=words):
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
