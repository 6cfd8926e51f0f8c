"""Where outputs go: nothing of the user's is replaced, nothing half-written is left, any name will do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from splashbench.cli.main import main
from splashbench.errors import SplashbenchError
from splashbench.files import as_asked, files_together

Fails = Callable[..., str]


def test_replace_never_takes_an_input_or_a_strangers_folder(balls_copy: Path, tmp_path: Path, fails: Fails) -> None:
    mine = tmp_path / "photos"
    mine.mkdir()
    (mine / "holiday.jpg").write_bytes(b"dear")
    run = ["run", "oracle", balls_copy]
    assert f"{balls_copy} holds the input" in fails(*run, balls_copy, "--replace")
    assert f"{tmp_path} holds the input" in fails(*run, tmp_path, "--replace")
    assert "it has no submission.toml" in fails(*run, mine, "--replace")
    assert "holiday.jpg is a file" in fails(*run, mine / "holiday.jpg", "--replace")
    assert "it has no train_meta.json" in fails("synth", "scene", "balls", mine, "--replace")
    assert "not the demo's" in fails("demo", mine, "--fresh")
    assert (mine / "holiday.jpg").read_bytes() == b"dear"
    assert (balls_copy / "train_meta.json").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["balls", "photos"]


def test_a_session_is_never_replaced_by_its_scene(session: Path, fails: Fails) -> None:
    for place in (session, session.parent):
        assert f"{place} holds the input" in fails("prepare", session, place, "--replace")
    assert (session / "session.toml").is_file()


def test_a_link_stays_and_its_target_is_replaced(balls_directory: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "target")
    for _ in range(2):
        assert main(["run", "oracle", str(balls_directory), str(tmp_path / "link"), "--replace"]) == 0
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target" / "submission.toml").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "target"]


def test_a_place_that_cannot_be_is_told_before_the_work(
    balls_directory: Path, submission: Path, results: Path, tmp_path: Path, fails: Fails
) -> None:
    (tmp_path / "file").write_text("mine")
    scored = ["score", submission, "--scene", balls_directory]
    for place in (tmp_path / "file", tmp_path / "file" / "below"):
        assert f"{tmp_path / 'file'} is a file" in fails(*scored, "--out", place)
        assert f"{tmp_path / 'file'} is a file" in fails("leaderboard", results, place)
        assert str(place) in fails("run", "oracle", balls_directory, place)
    assert f"{submission} is a folder" in fails(*scored, "--out", tmp_path / "results", "--sheet", submission)
    assert not (tmp_path / "results").exists()
    assert (tmp_path / "file").read_text() == "mine"


def test_a_read_only_folder_is_told_before_the_work(
    balls_directory: Path,
    submission: Path,
    results: Path,
    tmp_path: Path,
    fails: Fails,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (locked := tmp_path / "locked").mkdir()
    # Root, as which tests often run, may write everywhere.
    monkeypatch.setattr("splashbench.files.places.os.access", lambda path, mode: Path(path) != locked)
    scored = ["score", submission, "--scene", balls_directory]
    assert f"{locked} may not be written" in fails(*scored, "--out", locked / "results")
    assert f"{locked} may not be written" in fails("leaderboard", results, locked / "board")
    assert f"{locked} may not be written" in fails("run", "oracle", balls_directory, locked / "out")
    assert f"{locked} may not be written" in fails("synth", "scene", "balls", locked / "balls")


def test_spaces_and_letters_of_any_script_in_paths(balls_directory: Path, tmp_path: Path) -> None:
    place = tmp_path / "ü ñ 日本"
    scene = Path(shutil.copytree(balls_directory, place / "the scene"))
    (scene / "scene.json").unlink()  # the folder's name is the scene's
    scene = scene.rename(place / "器 1")
    for words in (
        ["run", "oracle", scene, place / "o ut"],
        ["score", place / "o ut", "--scene", scene, "--out", place / "re sults", "--sheet", place / "shéet.png"],
        ["leaderboard", place / "re sults", place / "b oard"],
        ["scene", "info", scene],
    ):
        assert main([str(word) for word in words]) == 0


def test_files_appear_together_or_not_at_all(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("kept")
    with pytest.raises(ValueError), files_together(tmp_path / "out") as staging:
        (staging / "first").write_text("half")
        raise ValueError
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine"]
    with files_together(tmp_path / "out") as staging:
        (staging / "first").write_text("whole")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["first", "mine"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_files_come_together_into_a_folder_whose_own_folder_is_nobodys_to_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as a scene that is mounted: nothing can be renamed into it from beside it."""
    out = tmp_path / "out"
    out.mkdir()
    made: list[Path] = []
    make = Path.mkdir

    def noting(path: Path, *words: object, **how: object) -> None:
        made.append(path)
        make(path, *words, **how)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "mkdir", noting)
    with files_together(out) as staging:
        assert staging.parent == out
        (staging / "first").write_text("whole")
        with pytest.raises(SplashbenchError, match=rf"{out}/second is a folder"):
            raise SplashbenchError(as_asked(f"{staging / 'second'} is a folder"))
    assert [path for path in made if path.parent == tmp_path and path != out] == []
    assert [path.name for path in out.iterdir()] == ["first"]


def test_files_that_belong_together_do_not_come_in_part(tmp_path: Path) -> None:
    (tmp_path / "out" / "b.txt").mkdir(parents=True)
    with pytest.raises(SplashbenchError, match=r"b\.txt is a folder"), files_together(tmp_path / "out") as staging:
        for name in ("a.txt", "b.txt", "c.txt"):
            (staging / name).write_text("new")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["b.txt"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_picture_takes_no_file_of_the_scene_and_is_a_png(
    balls_copy: Path, submission: Path, tmp_path: Path, fails: Fails
) -> None:
    photograph = balls_copy / "ims" / "1" / "000000.png"
    before = photograph.read_bytes()
    scored = ["score", submission, "--scene", balls_copy, "--out", tmp_path / "results", "--sheet"]
    assert f"{photograph} is a file of" in fails(*scored, photograph)
    assert "give a name that ends in .png" in fails(*scored, tmp_path / "sheet.txt")
    assert f"{photograph} is a file of" in fails(
        "scene", "reconstruct-container", balls_copy, "--replace", "--picture", photograph
    )
    assert photograph.read_bytes() == before
    assert not (tmp_path / "results").exists()


def test_nothing_goes_into_a_sealed_submission(
    balls_directory: Path, results: Path, submission: Path, fails: Fails
) -> None:
    sealed = f"lies in {submission}, whose files are sealed"
    assert sealed in fails("leaderboard", results, submission / "board")
    masks = balls_directory / "seg"
    assert sealed in fails("masks", "compare", masks, masks, "--out", submission / "masks")
    assert sealed in fails("scene", "export", balls_directory, submission / "scene", "--format", "colmap")
    assert main(["check", str(submission)]) == 0


def test_a_study_does_not_work_in_its_scene(balls_copy: Path, fails: Fails) -> None:
    words = ["study", "stress", balls_copy / "out", "--methods", "hull_points", "--scenes", balls_copy]
    assert f"lies in the scene {balls_copy}" in fails(*words, "--kinds", "haze", "--severities", "3")
    assert not (balls_copy / "out").exists()
