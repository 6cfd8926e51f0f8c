"""Raw against refined masks: the paper's figures on masks whose figures are known, and the pictures people judge by."""

from __future__ import annotations

import csv
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.files import read_image, write_png
from splashbench.prepare.masks.comparison import (
    change_rows,
    compare_folders,
    compare_mask_sets,
    find_mask_sets,
    mask_change,
    worst_pairs,
)
from splashbench.prepare.masks.comparison_report import change_table, pair_table, write_report
from splashbench.prepare.masks.drawing import ADDED, OUTLINE, REMOVED, changed, outlined
from splashbench.prepare.masks.sheet import (
    EMPTY,
    FLICKERING,
    FLOODED,
    MISSED,
    VANISHED,
    SheetCell,
    mask_faults,
    mask_sheet,
    sheet_of_set,
    sheet_times,
)

HEIGHT, WIDTH = 20, 50  # 1000 pixels


def bar(start: int, stop: int) -> np.ndarray:
    """A mask of 10 (stop - start) pixels."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[5:15, start:stop] = True
    return mask


def write(folder: Path, masks: dict[str, dict[int, np.ndarray]]) -> Path:
    for camera, frames in masks.items():
        for index, mask in frames.items():
            path = folder / camera / f"{index:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, mask.astype(np.uint8) * 255)
    return folder


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Camera 1: equal, half added, a fifth removed, raw empty, both empty. Camera 2: equal twice."""
    nothing = bar(0, 0)
    raw = {
        "1": {0: bar(0, 10), 1: bar(0, 10), 2: bar(0, 10), 3: nothing, 4: nothing},
        "2": {0: bar(3, 9), 1: bar(4, 9)},
    }
    refined = {
        "1": {0: bar(0, 10), 1: bar(0, 20), 2: bar(0, 8), 3: bar(0, 5), 4: nothing},
        "2": {0: bar(3, 9), 1: bar(4, 9)},
    }
    return write(tmp_path / "raw", raw), write(tmp_path / "refined", refined)


def test_the_papers_figures_are_means_over_masks(folders: tuple[Path, Path]) -> None:
    (comparison,) = compare_folders(*folders)
    change = mask_change(comparison.pairs["1"])
    assert change.n_masks == 5
    assert change.n_blank == 1
    assert change.mean_iou == pytest.approx((1 + 0.5 + 0.8 + 0) / 4)
    assert change.median_iou == pytest.approx(0.65)
    assert change.added_share == pytest.approx((0.5 + 1) / 4)
    assert change.removed_share == pytest.approx(0.2 / 4)
    assert change.mean_iou + change.added_share + change.removed_share == pytest.approx(1)
    assert change.empty_share == pytest.approx(2 / 5)
    assert change.touched_share == pytest.approx((0 + 0.1 + 0.02 + 0.05 + 0) / 5)
    assert change.raw_coverage == pytest.approx(0.3 / 5)
    assert change.refined_coverage == pytest.approx((0.1 + 0.2 + 0.08 + 0.05) / 5)
    rows = change_rows([comparison])
    assert list(rows) == [("refined", "1"), ("refined", "2"), ("refined", "all")]
    assert rows["refined", "2"].mean_iou == 1
    assert rows["refined", "all"].mean_iou == pytest.approx((2.3 + 2) / 6)


def test_a_frame_without_a_file_has_no_liquid(folders: tuple[Path, Path]) -> None:
    raw, refined = folders
    (expected,) = compare_folders(raw, refined)
    (raw / "1" / "000003.png").unlink()
    (refined / "1" / "000004.png").unlink()
    (found,) = compare_folders(raw, refined)
    assert found.pairs == expected.pairs


def test_several_scenes_go_by_name_and_are_put_together(folders: tuple[Path, Path], tmp_path: Path) -> None:
    raw, refined = folders
    for side, name in ((raw, "raws"), (refined, "refineds")):
        for scene in ("bowl", "tank"):
            target = tmp_path / name / scene / "seg"
            target.parent.mkdir(parents=True)
            side_copy = [(path, target / path.relative_to(side)) for path in side.rglob("*.png")]
            for source, copy in side_copy:
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(source.read_bytes())
            (target.parent / "train_meta.json").write_text("{}")
    comparisons = list(compare_folders(tmp_path / "raws", tmp_path / "refineds"))
    rows = change_rows(comparisons)
    assert [scene for scene, camera in rows if camera == "all"] == ["bowl", "tank", "all"]
    assert rows["all", "all"].n_masks == 14
    assert rows["all", "all"].mean_iou == pytest.approx(rows["bowl", "all"].mean_iou)
    (tmp_path / "raws" / "tank").rename(tmp_path / "raws" / "pan")
    with pytest.raises(SplashbenchError, match="refineds lacks the scene pan"):
        list(compare_folders(tmp_path / "raws", tmp_path / "refineds"))


def test_sets_that_do_not_fit_are_one_line(folders: tuple[Path, Path], tmp_path: Path) -> None:
    raw, _ = folders
    lone = write(tmp_path / "lone", {"1": {0: bar(0, 3)}})
    with pytest.raises(SplashbenchError, match=r"lone has no masks of camera 2, which .*raw has"):
        list(compare_folders(raw, lone))
    shifted = write(tmp_path / "shifted", {"1": {90: bar(0, 3)}})
    with pytest.raises(SplashbenchError, match=r"no frame of camera 1 has the name of one in .*lone \(such as 000000"):
        list(compare_folders(lone, shifted))
    large = write(tmp_path / "large", {"1": {0: np.ones((5, 5), bool)}})
    with pytest.raises(SplashbenchError, match=r"000000\.png is 50x20, but .*000000\.png is 5x5"):
        list(compare_folders(lone, large))
    (tmp_path / "nothing").mkdir()
    with pytest.raises(SplashbenchError, match="nothing has no masks"):
        find_mask_sets(tmp_path / "nothing")
    with pytest.raises(SplashbenchError, match="nowhere is not a folder"):
        find_mask_sets(tmp_path / "nowhere")
    (tmp_path / "nothing" / "train_meta.json").write_text("{}")
    with pytest.raises(SplashbenchError, match="seg is missing"):
        find_mask_sets(tmp_path / "nothing")


def test_nothing_anywhere_has_no_figures(tmp_path: Path) -> None:
    empty = write(tmp_path / "empty", {"1": {0: bar(0, 0)}})
    (comparison,) = compare_folders(empty, empty)
    change = mask_change(comparison.all_pairs)
    assert math.isnan(change.mean_iou)
    assert math.isnan(change.added_share)
    assert change.empty_share == 1
    assert worst_pairs(comparison, 6) == []


def test_the_report_holds_every_mask_and_a_picture(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (comparison,) = compare_folders(*folders)
    out = tmp_path / "out"
    out.mkdir()
    assert write_report([comparison], change_rows([comparison]), out) == ["masks.csv", "summary.csv", "comparison.png"]
    with (out / "masks.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 7
    assert rows[1]["added"] == "100"
    assert float(rows[1]["iou"]) == 0.5
    assert rows[4]["iou"] == ""
    with (out / "summary.csv").open() as stream:
        last = list(csv.DictReader(stream))[-1]
    assert float(last["mean_iou"]) == pytest.approx(4.3 / 6, abs=1e-6)
    picture = read_image(out / "comparison.png").astype(int)
    for colour in (ADDED, REMOVED):  # over black: 70% of the colour
        assert (np.abs(picture - 0.7 * np.array(colour)).max(axis=-1) < 3).sum() > 1000


def test_worst_masks_come_first_and_not_all_from_one_moment(tmp_path: Path) -> None:
    refined = {"1": {t: bar(0, 40) for t in range(40)}}
    raw = {"1": {t: bar(0, 10 + abs(t - 20)) for t in range(40)}}
    raw_set, refined_set = (
        find_mask_sets(write(tmp_path / name, masks))[0] for name, masks in (("raw", raw), ("refined", refined))
    )
    frames = [int(pair.frame) for pair in worst_pairs(compare_mask_sets(raw_set, refined_set), 3)]
    assert frames == [20, 15, 25]


def test_changes_and_outlines_are_where_they_should_be() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    shown = changed(image, bar(0, 20), bar(10, 30)).astype(int)
    for column, colour in ((5, REMOVED), (25, ADDED)):
        np.testing.assert_allclose(shown[10, column], 0.3 * 75 + 0.7 * np.array(colour), atol=1)
    assert (shown[10, 40] == 75).all()
    lines = outlined(image, bar(10, 20))
    assert (lines[10, 9] == OUTLINE).all()
    assert (lines[10, 8] == 0).all()
    assert (lines[10, 10:20] == 100).all()
    assert (outlined(image, np.ones_like(bar(0, 1)))[0] == OUTLINE).all()  # everything: framed


def test_faults_have_their_reasons() -> None:
    areas = {"1": [0, 50, 60, 0, 70, 5, 80, 900], "2": [10] * 8}
    faults = mask_faults(areas, {"1": 1000, "2": 1000}, {"2": [4]})
    assert faults == {"1": {0: EMPTY, 3: VANISHED, 5: FLICKERING, 7: FLOODED}, "2": {4: MISSED}}
    assert sheet_times(8, faults, 4) == [0, 3, 5, 7]
    assert sheet_times(8, {}, 4) == [1, 3, 5, 7]
    assert sheet_times(8, {"1": {6: FLOODED, 0: EMPTY}}, 2) == [0, 6]
    assert sheet_times(3, {}, 8) == [0, 1, 2]


def reddish(sheet: np.ndarray) -> int:
    levels = sheet.astype(int)
    return int(((levels[..., 0] > 200) & (levels[..., 1] < 40) & (levels[..., 2] < 40)).sum())


def test_the_sheet_frames_what_fails() -> None:
    image = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    good, bad = SheetCell(image, bar(5, 20)), SheetCell(image, bar(0, 0), EMPTY)
    plain = mask_sheet("pour", ["a", "b"], {"1": [good, good], "2": [good, good]})
    marked = mask_sheet("pour", ["a", "b"], {"1": [good, good], "2": [good, bad]}, {"2": "1 empty"})
    assert plain.shape == marked.shape
    assert plain.dtype == np.uint8
    assert reddish(plain) == 0
    assert reddish(marked) > 2 * (260 + 104)  # a frame around the cell
    half = plain.shape[1] // 2
    np.testing.assert_array_equal(plain[:, 130:half], marked[:, 130:half])
    with pytest.raises(ValueError, match="one cell per column"):
        mask_sheet("pour", ["a", "b"], {"1": [good]})


def test_a_scene_is_judged_across_views(balls_copy: Path) -> None:
    (masks,) = find_mask_sets(balls_copy)
    sheet, faults, remarks = sheet_of_set(masks, columns=4)
    assert remarks == []
    assert sheet.shape[1] > 4 * 260
    assert sum(map(len, faults.values())) == 0
    camera = min(masks.files)
    frame = sorted(masks.files[camera])[4]
    whole = read_image(Path(masks.files[camera][frame]))
    write_png(Path(masks.files[camera][frame]), np.zeros_like(whole[..., 0]))
    _, faults, _ = sheet_of_set(masks, columns=4)
    assert faults[camera] == {4: VANISHED}


def test_a_folder_needs_no_calibration_and_takes_images(folders: tuple[Path, Path], tmp_path: Path) -> None:
    raw, _ = folders
    (masks,) = find_mask_sets(raw)
    dark, faults, remarks = sheet_of_set(masks, columns=5)
    assert faults == {"1": {3: EMPTY, 4: EMPTY}, "2": {2: EMPTY, 3: EMPTY, 4: EMPTY}}
    assert "no calibrated scene" in remarks[0]
    for camera in ("1", "2"):
        for t in range(5):
            path = tmp_path / "frames" / camera / f"{t:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, np.full((HEIGHT, WIDTH, 3), 150, np.uint8))
    light, _, _ = sheet_of_set(masks, columns=5, images=tmp_path / "frames")
    assert (light == 150).all(-1).sum() > (dark == 150).all(-1).sum() + 10_000
    write_png(tmp_path / "frames" / "1" / "000000.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(SplashbenchError, match=r"000000\.png is 4x4, its mask 50x20"):
        sheet_of_set(masks, columns=5, images=tmp_path / "frames")


def test_a_sheet_has_room_for_so_many_pictures(
    folders: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splashbench.prepare.masks.sheet._MAX_CELLS", 1)
    (only,) = find_mask_sets(folders[0])[:1]
    with pytest.raises(SplashbenchError, match=r"are more than the 1 pictures that a sheet has room for"):
        sheet_of_set(only)


def test_photographs_of_neurofluids_layout_are_no_masks(tmp_path: Path) -> None:
    view = tmp_path / "WaterSphere" / "view_0"
    (view / "train").mkdir(parents=True)
    write_png(view / "train" / "r_000.png", np.zeros((4, 4, 3), np.uint8))
    (view / "transforms_train.json").write_text("{}")
    for place in (view.parent, view, view / "train"):
        with pytest.raises(SplashbenchError, match="is of a scene in NeuroFluid's layout"):
            find_mask_sets(place)


def test_masks_beside_the_cameras_of_an_exported_scene_are_masks(tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text("{}")
    write_png(tmp_path / "masks" / "1" / "0000.png", np.zeros((4, 4), np.uint8))
    assert [each.files["1"].keys() for each in find_mask_sets(tmp_path / "masks")] == [{"0000"}]


def test_names_of_strangers_are_no_formulas(folders: tuple[Path, Path], tmp_path: Path) -> None:
    for folder, name in zip(folders, ("a", "b")):
        shutil.copytree(folder, tmp_path / name)
        for camera in list((tmp_path / name).rglob("*")):
            if camera.is_dir() and any(camera.glob("*.png")):
                camera.rename(camera.with_name(f"=SUM({camera.name})"))
    (comparison,) = list(compare_folders(tmp_path / "a", tmp_path / "b"))[:1]
    assert ",'=SUM(" in pair_table([comparison])
    assert ",=SUM(" not in pair_table([comparison]) + change_table(change_rows([comparison]))
