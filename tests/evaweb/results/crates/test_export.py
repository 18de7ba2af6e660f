"""The crate of a plan: what it contains, that it is valid and reproducible, and that its program still agrees."""

import csv
import hashlib
import io
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from urllib.parse import urlencode

import pytest
from django.core.management import CommandError, call_command
from django.urls import reverse

from evaweb.accounts.models import Profile
from evaweb.core.errors import EvaError
from evaweb.episodes.folders import preview_video
from evaweb.results.crates import export, graph
from evaweb.results.crates.export import METADATA, write_crate
from evaweb.results.crates.options import CrateOptions
from tests.evaweb.results.reports.test_reporting import recompute
from tests.evaweb.trials import builders

ORCID = "0000-0002-1825-0097"
VALIDATOR = shutil.which("rocrate-validator", path=str(Path(sys.executable).parent)) or shutil.which(
    "rocrate-validator"
)
# What a plan does not know: people's affiliation and contact, and a permanent address of lab and program.
UNKNOWN = {
    "The organization SHOULD have a URL.",
    "An Organization entity SHOULD have a ROR identifier as its @id (e.g., https://ror.org/03f0f6041)",
    "An Organization's contactPoint SHOULD reference a ContactPoint contextual entity",
    "At least one author or publisher Person/Organization SHOULD have a contactPoint property",
    "The SoftwareApplication id SHOULD be an absolute URI",  # a package URL is one; the check demands http
    "A Person entity SHOULD have an ORCID identifier as its @id (e.g., https://orcid.org/0000-0001-2345-6789)",
}


def crate_of(plan, **options):
    pytest.importorskip("rocrate", reason="rocrate (extra crates) is not installed")
    target = io.BytesIO()
    written = write_crate(
        plan, CrateOptions(**{"license": "CC-BY-4.0", "lab": "Bench Lab", **options}), target
    )
    return target.getvalue(), written


def opened(content):
    """Files of a crate, and the entities of its metadata by their id."""
    with zipfile.ZipFile(io.BytesIO(content)) as packed:
        files = {name: packed.read(name) for name in packed.namelist()}
    return files, {entity["@id"]: entity for entity in json.loads(files[METADATA])["@graph"]}


def ids(value):
    return [row["@id"] for row in (value if isinstance(value, list) else [value])]


def test_a_crate_states_plan_people_program_actions_and_the_digest_of_every_file(revealed, owner):
    Profile.objects.create(user=owner, orcid=ORCID)
    files, graph = opened(crate_of(revealed, name="Blocks", description="Two policies.")[0])
    root = graph["./"]
    assert (root["name"], root["description"]) == ("Blocks", "Two policies.")
    assert root["license"] == {"@id": "https://spdx.org/licenses/CC-BY-4.0"}
    assert root["datePublished"] == f"{revealed.revealed_at:%Y-%m-%d}"
    assert graph[root["identifier"]["@id"]]["value"] == revealed.digest
    assert graph[root["publisher"]["@id"]]["name"] == "Bench Lab"
    assert root["author"] == {"@id": f"https://orcid.org/{ORCID}"}
    assert graph[root["author"]["@id"]]["name"] == "olga"
    assert ids(root["contributor"]) == ["#person-ann"]
    assert set(ids(root["hasPart"])) == set(files) - {METADATA}
    for name in ids(root["hasPart"]):
        assert graph[name]["sha256"] == hashlib.sha256(files[name]).hexdigest(), name
        assert graph[name]["contentSize"] == str(len(files[name]))
    trials, analysis = (graph[name] for name in ids(root["mentions"]))
    assert graph[trials["instrument"]["@id"]]["@type"] == "SoftwareApplication"
    assert trials["agent"] == {"@id": "#person-ann"}
    assert "data/plan.json" in ids(trials["object"])
    assert {graph[name].get("name") for name in ids(trials["object"])} >= {"pi0-block", "pi0-new"}
    assert {"data/trials.csv", "data/scores.csv"} <= set(ids(trials["result"]))
    assert set(ids(analysis["result"])) == {"index.html", "data/numbers.json", "data/integrity.json"}
    assert trials["startTime"] <= trials["endTime"] <= analysis["endTime"]
    assert json.loads(files["data/plan.json"]) == revealed.document


def test_two_accounts_with_one_orcid_are_one_person(revealed, owner, bench):
    for user in (owner, bench.operator):
        Profile.objects.create(user=user, orcid=ORCID)
    _, graph = opened(crate_of(revealed)[0])
    person = graph["./"]["author"]["@id"]
    assert graph[person]["name"] == "ann, olga"
    assert graph["#evaluation"]["agent"] == {"@id": person}
    assert "contributor" not in graph["./"]


def test_the_same_plan_and_options_give_the_same_bytes(revealed):
    content, _ = crate_of(revealed)
    assert crate_of(revealed)[0] == content
    assert crate_of(revealed, license="CC0-1.0")[0] != content


def test_the_program_in_a_crate_computes_every_number_again(revealed, tmp_path):
    with zipfile.ZipFile(io.BytesIO(crate_of(revealed)[0])) as packed:
        packed.extractall(tmp_path / "crate")
    found = recompute(tmp_path / "crate")
    assert found.returncode == 0, found.stdout + found.stderr


def test_videos_of_trials_that_count_are_there_if_they_are_asked_for(revealed, monkeypatch):
    here = revealed.handouts.order_by("number").first().trial
    preview_video(here.episode_id, "top").write_bytes(b"video")
    content, written = crate_of(revealed, videos=True)
    files, graph = opened(content)
    name = f"videos/trial-{here.pk}-top.mp4"
    assert (files[name], written.videos, written.absent) == (b"video", 1, 15)
    assert name in ids(graph["#evaluation"]["result"])
    assert "15 videos are left out" in graph["#evaluation"]["description"]
    rows = csv.DictReader(io.StringIO(files["data/trials.csv"].decode()))
    assert str(here.pk) in {row["trial"] for row in rows}
    assert not any(name.startswith("videos/") for name in opened(crate_of(revealed)[0])[0])
    fetched = []
    monkeypatch.setattr(
        export,
        "video_file",
        lambda uuid, camera: fetched.append(uuid) or preview_video(here.episode_id, "top"),
    )
    with pytest.raises(EvaError, match="allowed here: 4"):
        write_crate(revealed, CrateOptions("MIT", videos=True), io.BytesIO(), most_videos=4)
    assert fetched == [here.episode_id]  # and none of the others from the store


@pytest.mark.parametrize(
    ("option", "given", "why"),
    [
        ("license", "WTFPL", "allowed: CC-BY-4.0, CC0-1.0"),
        ("date", "31.3.2026", "such as 2026-03-31"),
        ("name", "a\u202eb", "one line"),
        ("lab", "x" * 201, "at most 200"),
        ("description", "a\r\nb\x0bc", "one line"),
    ],
)
def test_an_option_that_is_not_allowed_is_named(option, given, why):
    with pytest.raises(EvaError, match=why) as refused:
        CrateOptions(**{"license": "MIT", option: given})
    assert option in str(refused.value)


def test_without_rocrate_the_extra_is_named(revealed, monkeypatch):
    monkeypatch.setitem(sys.modules, "rocrate", None)
    with pytest.raises(EvaError, match=r"pip install 'eva-web\[crates\]'"):
        graph.rocrate_library()


# Fills the validator's cache with the JSON-LD context that rocrate brings along, so that nothing asks for a network.
WARM = """
import io, sys
from importlib.resources import files
from requests.adapters import HTTPAdapter
from requests_cache import CachedSession
from urllib3 import HTTPResponse

class Packaged(HTTPAdapter):
    def send(self, request, **options):
        body = io.BytesIO((files("rocrate") / "data" / "ro-crate.jsonld").read_bytes())
        headers = {"Content-Type": "application/ld+json"}
        return self.build_response(request, HTTPResponse(body, headers, 200, preload_content=False))

session = CachedSession(cache_name=sys.argv[1], expire_after=-1, backend="sqlite")
session.mount("https://w3id.org/", Packaged())
accept = {"Accept": "application/ld+json, application/json"}
session.get("https://w3id.org/ro/crate/1.3/context", headers=accept)
"""


@pytest.mark.parametrize(
    "profile", [("ro-crate-1.3",), ("process-run-crate-0.5", "--disable-profile-inheritance")]
)
def test_the_validator_finds_nothing_without_a_network(revealed, owner, tmp_path, profile):
    """Process Run Crate 0.5 is checked without what it inherits, which demands version 1.1 of RO-Crate."""
    if VALIDATOR is None:
        pytest.skip("rocrate-validator is not installed: make crates")
    Profile.objects.create(user=owner, orcid=ORCID)
    crate, cache, report = (tmp_path / name for name in ("crate", "cache", "report.json"))
    with zipfile.ZipFile(io.BytesIO(crate_of(revealed)[0])) as packed:
        packed.extractall(crate)  # of a zip the validator writes no JSON
    python = Path(VALIDATOR).with_name("python")
    subprocess.run([python, "-c", WARM, cache], check=True)
    words = [
        VALIDATOR,
        "-y",
        "validate",
        "--offline",
        "--cache-path",
        cache,
        "-p",
        *profile,
        "-l",
        "recommended",
    ]
    words += ["--skip-availability-check", "-f", "json", "-o", report, crate]
    done = subprocess.run(words, capture_output=True, text=True)
    assert report.read_bytes(), done.stdout + done.stderr
    found = json.loads(report.read_text("utf-8"))
    assert found["statistics"]["total_checks"] > 30
    said = {(row["severity"], row["message"], row["violatingEntity"]) for row in found["issues"]}
    assert {row for row in said if row[0] == "REQUIRED" or row[1] not in UNKNOWN} == set()


# --- ways out -----------------------------------------------------------------------------------------------


def addresses_of(plan):
    chosen = {"license": "CC-BY-4.0", "lab": "Bench Lab"}
    page = reverse("result-crate", args=[plan.name, plan.version])
    rest = reverse("api:plan-crate", args=[plan.name, plan.version])
    return [f"{address}?{urlencode(chosen)}" for address in (page, rest)]


def test_page_rest_and_command_give_the_same_file_to_whoever_may_see_the_results(revealed, client, tmp_path):
    pytest.importorskip("rocrate", reason="rocrate (extra crates) is not installed")
    client.force_login(builders.user("vera", "viewer"))
    out = tmp_path / "blocks.zip"
    call_command(
        "crates", "export", "blocks", "--out", str(out), "--license", "CC-BY-4.0", "--lab", "Bench Lab"
    )
    for address in addresses_of(revealed):
        answer = client.get(address)
        assert (answer.status_code, answer["Content-Type"]) == (200, "application/zip")
        assert answer["Content-Disposition"] == 'attachment; filename="blocks-v1-crate.zip"'
        assert b"".join(answer.streaming_content) == out.read_bytes()
    with pytest.raises(CommandError, match="name a new file"):
        call_command("crates", "export", "blocks", "--out", str(out), "--license", "MIT")


def test_the_page_names_what_is_not_allowed_and_keeps_what_was_typed(revealed, client, owner):
    client.force_login(owner)
    address = reverse("result-crate", args=["blocks", 1])
    page = client.get(address).content.decode()
    assert "CC-BY-4.0: Creative Commons Attribution" in page
    assert "state yours" in page
    refused = client.get(address, {"license": "MIT", "date": "soon", "lab": "Lab & Co"})
    assert refused.status_code == 400
    assert "such as 2026-03-31" in refused.content.decode()
    assert 'value="Lab &amp; Co"' in refused.content.decode()


def test_a_sealed_plan_leaves_by_no_way(plan, carry_out, client, bench, owner, tmp_path):
    carry_out(plan, 3)
    for user in (bench.operator, owner):
        client.force_login(user)
        page, rest = (client.get(address) for address in addresses_of(plan))
        assert page["Content-Type"].startswith("text/html")
        assert "Sealed" in page.content.decode()
        assert "pi0-" not in page.content.decode()
        assert (rest.status_code, "blind until it is revealed" in rest.json()["error"]) == (403, True)
    with pytest.raises(CommandError, match="--sealed"):
        call_command("crates", "export", "blocks", "--out", str(tmp_path / "a.zip"), "--license", "MIT")
    assert not list(tmp_path.glob("*.zip"))
