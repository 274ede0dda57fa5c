"""The Kubernetes manifests: as the table of processes says, valid for the API, whole once their kustomizations are applied."""

import re
import runpy
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from penumbra.shared.contract import access
from penumbra.shared.contract.processes import PROCESSES

FOLDER = Path(__file__).parents[1] / "docker" / "kubernetes"
KUSTOMIZATIONS = sorted(path.parent.name for path in FOLDER.glob("*/kustomization.yaml"))


def merged(base, patch):
    """A strategic merge as Kubernetes does it, for what our patches contain: lists of named parts are merged by their names."""
    if isinstance(base, dict) and isinstance(patch, dict):
        return {key: merged(base.get(key), patch[key]) if key in patch else base[key] for key in {**base, **patch}}
    if isinstance(base, list) and isinstance(patch, list) and patch and isinstance(patch[0], dict):
        names = [each["name"] for each in base]
        changed = {each["name"]: each for each in patch}
        kept = [merged(each, changed[each["name"]]) if each["name"] in changed else each for each in base]
        return kept + [each for each in patch if each["name"] not in names]
    return patch


def built(folder):
    """What `kubectl kustomize` makes of a folder: its objects by kind and name."""
    found: dict[tuple[str, str], dict] = {}
    kustomization = yaml.safe_load((FOLDER / folder / "kustomization.yaml").read_text())
    for resource in kustomization["resources"]:
        if (FOLDER / folder / resource).is_dir():
            found |= built((FOLDER / folder / resource).resolve().name)
        else:
            objects = yaml.safe_load_all((FOLDER / folder / resource).read_text())
            found |= {(each["kind"], each["metadata"]["name"]): each for each in objects}
    for patch in kustomization.get("patches", []):
        change = yaml.safe_load(patch["patch"] if "patch" in patch else (FOLDER / folder / patch["path"]).read_text())
        key = (change["kind"], change["metadata"]["name"])
        assert key in found, f"{folder}: a patch of {key}, which is not there"
        if change.get("$patch") == "delete":
            del found[key]
        else:
            found[key] = merged(found[key], change)
    return found


def pods(objects):
    return {name: each["spec"]["template"]["spec"] for (_, name), each in objects.items() if "template" in each.get("spec", {})}


def test_the_files_are_those_of_the_table():
    written = {path.relative_to(FOLDER).as_posix(): path.read_text() for path in FOLDER.rglob("*.yaml")}
    assert written == runpy.run_path(str(FOLDER / "generate.py"))["manifests"](), "run `just kubernetes`"


@pytest.mark.parametrize("folder", KUSTOMIZATIONS)
def test_every_object_is_valid_for_the_api(folder):
    for each in built(folder).values():
        kubernetes_validate.validate(each, kubernetes_validate.latest_version(), strict=True)


def test_the_schemas_refuse_a_wrong_object():
    router = built("base")["DaemonSet", "router"]
    router["spec"]["template"]["spec"]["containers"][0]["image"] = 3
    with pytest.raises(kubernetes_validate.ValidationError):
        kubernetes_validate.validate(router, kubernetes_validate.latest_version(), strict=True)


def test_every_process_has_a_deployment_in_some_kustomization():
    found = {name for folder in KUSTOMIZATIONS for name in pods(built(folder))}
    assert found == {process.name for process in PROCESSES} | {"hub"}
    assert {"segmentation", "search"} <= pods(built("base")).keys()
    assert not {"segmentation", "search"} & pods(built("posecnn")).keys()


def test_replicas_of_fusion_are_spread_and_processes_with_devices_stay_with_them():
    fusion = built("base")["Deployment", "fusion"]["spec"]
    assert fusion["replicas"] == 2
    assert fusion["template"]["spec"]["topologySpreadConstraints"][0]["topologyKey"] == "kubernetes.io/hostname"
    for folder, name in (("simulated", "emulator"), ("boards", "skin"), ("cameras", "camera"), ("robots", "robot")):
        spec = built(folder)["Deployment", name]["spec"]
        assert spec["strategy"] == {"type": "Recreate"}, "two of them would publish the same keys"
        assert list(spec["template"]["spec"]["nodeSelector"].values()) == ["true"]


@pytest.mark.parametrize("folder", KUSTOMIZATIONS)
def test_a_container_has_no_rights_but_the_driver_of_the_boards(folder):
    for name, pod in pods(built(folder)).items():
        (container,) = pod["containers"]
        assert pod["securityContext"]["runAsNonRoot"]
        assert container["securityContext"]["readOnlyRootFilesystem"]
        assert (container["securityContext"].get("capabilities") == {"drop": ["ALL"]}) == (name != "skin")
        assert {volume["name"] for volume in pod["volumes"]} == {mount["name"] for mount in container["volumeMounts"]}


def test_the_page_of_deployment_names_every_folder_and_makes_every_secret():
    page = (FOLDER.parents[1] / "docs" / "deployment.md").read_text()
    assert set(KUSTOMIZATIONS) == set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    (made,) = re.findall(r"for service in (.*); do", page)
    text = "".join(path.read_text() for path in (FOLDER / "secure").glob("*.yaml"))
    assert {f"penumbra-{name}" for name in made.split()} == set(re.findall(r"secretName: (\S+)", text))


def test_with_tls_each_pod_has_the_certificate_of_its_own_and_everything_goes_by_tls():
    objects = built("secure")
    holders = {name: [v["secret"]["secretName"] for v in pod["volumes"] if "secret" in v] for name, pod in pods(objects).items()}
    assert holders == {name: [f"penumbra-{'router' if name == 'hub' else name}"] for name in holders}
    assert {name.removeprefix("penumbra-") for (name,) in holders.values()} <= set(access.HOLDERS)
    assert "tcp/" not in yaml.safe_dump_all(objects.values())
