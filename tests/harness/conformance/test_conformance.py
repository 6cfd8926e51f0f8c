"""The conformance test passes sound methods, and finds each misbehaviour by the line that is about it."""

import os
import re
from pathlib import Path

import pytest

from splashbench.errors import SplashbenchError
from splashbench.harness.conformance import Report, Verdict, conform, evidence

METHODS = Path(__file__).with_name("methods_for_conformance.py")
RENDERING = ["files", "load", "again", "views", "between", "size", "principal_point"]
SCENE = ["same_seed", "hidden_test_views", "unread_test_views", "unchanged_scene", "writes"]


def tried(name: str, only: list[str] | None, **options) -> Report:
    return conform(f"{METHODS}:{name}", only=only, **options)


def verdicts(report: Report, verdict: Verdict) -> dict[str, str]:
    return {finding.name: finding.detail for finding in report.findings if finding.verdict == verdict}


def test_a_sound_method_passes_every_check() -> None:
    heard: list[str] = []
    report = tried("Sky", None, tell=lambda finding: heard.append(finding.name))
    assert {finding.name: finding.detail for finding in report.findings if finding.verdict != Verdict.OK} == {}
    assert report.passed
    assert heard == [finding.name for finding in report.findings]
    assert len(heard) == 25
    assert report.preset == "quick"
    assert report.fit_seconds is not None


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Titleless", "title ' ' is no line of text"),
        ("ForgetsSettings", "others after being written as JSON"),
        ("BadPreset", "preset slow: setting step: Extra inputs are not permitted"),
    ],
)
def test_metadata_that_is_not_valid(name: str, said: str) -> None:
    report = tried(name, ["metadata"], overrides={"steps": 2})
    assert said in verdicts(report, Verdict.FAILED)["metadata"]
    assert not report.passed


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("Silent", "reported none"),
        ("Wordless", "none of 3 reports says what is being done"),
        ("Backwards", "report 2 goes back from 1 to 0.666667"),
        ("Percent", "report 2 is 33.3333, outside [0, 1]"),
    ],
)
def test_progress_that_tells_nothing(name: str, said: str) -> None:
    assert said in verdicts(tried(name, ["progress"]), Verdict.FAILED)["progress"]


@pytest.mark.parametrize(
    ("name", "failed"),
    [
        ("Pickles", {"files": "model is or holds a pickle"}),
        ("Rounds", {"load": "camera 6, timestep 0 differs from the model in memory, as 2"}),
        ("SavesElsewhere", {"load": "No such file"}),
        ("Counts", {"again": "when all views are rendered again"}),
        ("OneSize", {"size": "the view is (81, 59) pixels", "principal_point": "the view is (32, 48) pixels"}),
        ("Centred", {"principal_point": "shows the part around the middle of the image"}),
        ("FramesOnly", {"between": "render() raised ValueError"}),
        ("NotANumber", dict.fromkeys(["views", "between", "size", "principal_point"], "has NaN or infinite pixels")),
    ],
)
def test_models_that_are_not_what_they_seem(name: str, failed: dict[str, str]) -> None:
    details = verdicts(tried(name, RENDERING), Verdict.FAILED)
    assert set(details) == set(failed)
    for check, said in failed.items():
        assert said in details[check]


@pytest.mark.parametrize(
    ("name", "only", "failed"),
    [
        ("Unseeded", SCENE, {"same_seed": "in a second fit with seed 0"}),
        ("Peeks", SCENE, {"hidden_test_views": "where they can be read", "unread_test_views": "ims/6/000000.png"}),
        (
            "PeeksNatively",
            ["hidden_test_views", "unread_test_views"],
            {"hidden_test_views": "where they can be read", "unread_test_views": "ims/6/000000"},
        ),
        ("PeeksInVain", ["unread_test_views"], {"unread_test_views": "it looked into ims/6/000000.png"}),
        pytest.param(
            "PeeksNativelyInVain",
            ["unread_test_views"],
            {"unread_test_views": "it looked into ims/6/000000.png"},
            marks=pytest.mark.slow,
        ),
        ("Lists", ["unread_test_views"], {"unread_test_views": "it looked into ims"}),
        (
            "PeeksWhenLoaded",
            ["load", "same_seed", "hidden_test_views", "unread_test_views"],
            {"hidden_test_views": "where they can be read", "unread_test_views": "ims/6/000000.png"},
        ),
        ("Scribbles", ["unchanged_scene", "writes"], {"unchanged_scene": "ims/1/000000.png was changed"}),
        ("KeepsNotes", ["unchanged_scene", "writes"], {"unchanged_scene": "notes.json was changed"}),
    ],
)
def test_fits_that_use_what_they_may_not(name: str, only: list[str], failed: dict[str, str]) -> None:
    report = tried(name, only)
    details = verdicts(report, Verdict.FAILED)
    assert set(details) == set(failed)
    for check, said in failed.items():
        assert said in details[check]
    # With fits that differ by chance nothing can be told from the one that could read test views.
    undecided = {"hidden_test_views"} if name == "Unseeded" else set()
    assert set(verdicts(report, Verdict.NOT_TESTED)) == undecided


@pytest.mark.parametrize(
    ("name", "failed", "said"),
    [
        ("FewParticles", "particles", "particles cover 7 of 8 timesteps"),
        ("PhiAsAnArray", "signed_distance", "returned ndarray, not a SignedDistance"),
    ],
)
def test_geometry_that_is_not_whole(name: str, failed: str, said: str) -> None:
    details = verdicts(tried(name, ["views", "particles", "signed_distance"]), Verdict.FAILED)
    assert set(details) == {failed}
    assert said in details[failed]


def test_states_on_the_way_are_taken() -> None:
    assert verdicts(tried("Offers", ["checkpoints"]), Verdict.OK) == {"checkpoints": "2 states"}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("OffersAndChanges", "camera 6, timestep 0 differs where states were taken on the way"),
        ("OffersTooEarly", "not_finite: camera 6, timestep 0: the render has NaN"),
    ],
)
def test_states_on_the_way_that_are_wrong_or_change_the_fit(name: str, said: str) -> None:
    assert said in verdicts(tried(name, ["checkpoints"]), Verdict.FAILED)["checkpoints"]


@pytest.mark.parametrize(
    ("name", "verdict", "said"),
    [
        ("Sky", Verdict.OK, r"^it takes none$"),
        ("Thrifty", Verdict.OK, r"^\d\.\d of \d\.\d s; 0\.00\d of 0\.03\d MB; not tried: memory_bytes$"),
        ("Spendthrift", Verdict.FAILED, r"^a budget of 0\.03\d+ MB of storage could not be kept: 0\.05"),
        ("Late", Verdict.FAILED, r"^a budget of 0\.\d+ s could not be kept: 1"),
        ("Misspelt", Verdict.FAILED, "^budgets names 'storage'; there are seconds, storage_bytes, memory_bytes$"),
        ("GivesUp", Verdict.FAILED, "^crashed: so few bytes are no model; give more$"),
    ],
)
def test_budgets_that_a_method_says_it_keeps_to(
    name: str, verdict: Verdict, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence, "_LEAST_SECONDS", 0.2)
    assert re.search(said, verdicts(tried(name, ["budgets"]), verdict)["budgets"])


def test_a_run_with_a_budget_that_is_refused_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    run_method = evidence.run_method

    def refusing(*arguments, budget=None, **options):
        if budget is not None:
            raise SplashbenchError("no such budget")
        return run_method(*arguments, **options)

    monkeypatch.setattr(evidence, "run_method", refusing)
    assert verdicts(tried("Spendthrift", ["budgets"]), Verdict.FAILED) == {"budgets": "refused: no such budget"}


def test_seconds_are_not_asked_of_a_fit_that_is_short_already() -> None:
    report = tried("Late", ["budgets"])
    assert verdicts(report, Verdict.OK) == {"budgets": "not tried: seconds"}


def test_a_seed_that_is_refused() -> None:
    assert "KeyError" in verdicts(tried("OneSeed", ["other_seed"]), Verdict.FAILED)["other_seed"]


@pytest.mark.parametrize("name", ["Litters", "LittersFromAFork"])
def test_a_file_written_elsewhere_is_a_warning(tmp_path: Path, name: str) -> None:
    place = tmp_path / "notes"
    report = tried(name, ["writes"], overrides={"place": str(place)})
    assert verdicts(report, Verdict.WARNING) == {"writes": f"it writes {place}"}
    assert report.passed


def test_a_process_left_behind_is_found_and_ended() -> None:
    import psutil

    detail = verdicts(tried("LeavesProcess", ["processes"]), Verdict.FAILED)["processes"]
    left = re.fullmatch(r"sleep \(process (\d+)\), after the process to fit", detail)
    assert left
    assert not psutil.pid_exists(int(left[1])) or psutil.Process(int(left[1])).status() == psutil.STATUS_ZOMBIE


@pytest.mark.parametrize(
    ("name", "failed", "ok"),
    [
        ("NeedsFrames", {"one_frame": "it ends in fit: IndexError"}, {"no_liquid": "it is reconstructed"}),
        ("NeedsLiquid", {"no_liquid": "it ends in fit: ZeroDivisionError"}, {"one_frame": "it is reconstructed"}),
        (
            "SaysSo",
            {},
            {"one_frame": "it is refused: needs two timesteps", "no_liquid": "it is refused: there is no liquid"},
        ),
        ("Mute", dict.fromkeys(["one_frame", "no_liquid"], "it ends in supports: without a reason"), {}),
    ],
)
def test_scenes_that_it_cannot_take(name: str, failed: dict[str, str], ok: dict[str, str]) -> None:
    report = tried(name, ["one_frame", "no_liquid"])
    for verdict, expected in ((Verdict.FAILED, failed), (Verdict.OK, ok)):
        details = verdicts(report, verdict)
        assert set(details) == set(expected)
        for check, said in expected.items():
            assert said in details[check]


def test_what_cannot_be_told_is_not_called_ok() -> None:
    report = tried("Mute", ["fit", "load", "again", "hidden_test_views"])
    assert "it does not take this scene" in verdicts(report, Verdict.FAILED)["fit"]
    assert set(verdicts(report, Verdict.NOT_TESTED)) == {"load", "again", "hidden_test_views"}
    assert not report.passed


def test_a_scene_of_the_users_is_copied_and_left_alone(balls_copy: Path) -> None:
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in balls_copy.rglob("*") if path.is_file()}
    report = tried("Scribbles", ["unchanged_scene"], scene=balls_copy)
    assert not report.passed
    assert before == {
        path: (path.read_bytes(), path.stat().st_mtime_ns) for path in balls_copy.rglob("*") if path.is_file()
    }


def test_a_damaged_scene_is_told_by_its_own_name(balls_copy: Path) -> None:
    (balls_copy / "ims" / "1" / "000003.png").unlink()
    with pytest.raises(SplashbenchError, match=f"{balls_copy}/ims/1/000003.png is missing"):
        tried("Sky", ["fit"], scene=balls_copy)


def test_nothing_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    environment = dict(os.environ)
    assert not tried("Rounds", ["load", "processes"]).passed
    assert list(tmp_path.iterdir()) == []
    assert dict(os.environ) == environment


def test_wrong_names_are_told_before_anything_runs() -> None:
    with pytest.raises(SplashbenchError, match="no check 'laod'; did you mean 'load'"):
        tried("Sky", ["laod"])
    with pytest.raises(SplashbenchError, match="no preset 'fast'"):
        tried("Sky", None, preset="fast")
    with pytest.raises(SplashbenchError, match="runs on cpu, not on 'cuda'"):
        tried("Sky", None, device="cuda")
    with pytest.raises(SplashbenchError, match="is not a folder"):
        tried("Sky", None, scene=Path("nowhere"))
    with pytest.raises(SplashbenchError, match="oracle is no method that could be tested"):
        conform("oracle")
