"""What is sent when: once for each timestep, the shown one first, the whole of it while it stands still."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from splashbench.errors import SplashbenchError
from splashbench.viewer.exhibit import Extent
from splashbench.viewer.layers import FixedLayer, Layer, Moment, TimedLayer
from splashbench.viewer.merging import Lookout
from splashbench.viewer.splat_layer import SplatLayer
from splashbench.viewer.stage import Stage, coarser

from .conftest import NUMBER, FakeScene, FakeServer, MadeUp

STILL, PLAYING = Moment(0, False), Moment(0, True)
#: So near that nothing is merged.
NEAR = Lookout(np.array([0.0, 0.0, 1.0]), 1e-5)


def work(layer: Layer, moment: Moment, ahead: bool = True) -> int:
    """Do what the layer lacks, as the worker does; how many jobs that were."""
    done = 0
    while (job := layer.urgent(moment) or (layer.ahead(moment) if ahead else None)) is not None:
        job()
        layer.show(moment)
        done += 1
        assert done < 100, "it never comes to an end"
    return done


@pytest.fixture
def scene() -> FakeScene:
    return FakeScene()


@pytest.fixture
def timed(scene: FakeScene) -> TimedLayer:
    def make(t: int) -> Any:
        return None if t == 3 else scene.add_thing(f"/{t}", visible=False)

    return TimedLayer("thing", "thing", threading.RLock(), make, 5, on=True)


def splats(server: FakeServer, made_up: MadeUp, budget: int = 10**6, lookout: Lookout = NEAR) -> SplatLayer:
    return SplatLayer(
        server.scene,
        "/liquid",
        threading.RLock(),
        server.atomic,
        made_up.gaussians,
        made_up.n_frames,
        lookout,
        np.zeros(3),
        budget=budget,
    )


def test_every_timestep_is_made_once_the_shown_one_first(timed: TimedLayer, scene: FakeScene) -> None:
    assert work(timed, Moment(2, False)) == 5
    assert [node.name for node in scene.nodes] == ["/2", "/4", "/0", "/1"]
    assert timed.loading is None
    for t in (2, 3, 4, 0, 2):
        timed.show(Moment(t, True))
        assert scene.shown() == ([] if t == 3 else [f"/{t}"])
    assert all(node.sent == 1 for node in scene.nodes)


def test_playing_toggles_two_nodes_a_step(timed: TimedLayer, scene: FakeScene) -> None:
    work(timed, STILL)
    before = scene.toggles
    timed.show(Moment(1, True))
    timed.show(Moment(1, True))
    assert scene.toggles - before == 2


def test_a_timestep_that_is_not_made_yet_shows_nothing_of_another(timed: TimedLayer, scene: FakeScene) -> None:
    work(timed, STILL, ahead=False)
    timed.show(Moment(1, True))
    assert scene.shown() == []
    assert timed.loading == (1, 5)


def test_what_is_off_is_not_made(timed: TimedLayer, scene: FakeScene) -> None:
    timed.switch(False, STILL)
    assert work(timed, STILL) == 0
    timed.switch(True, STILL)
    work(timed, STILL)
    timed.switch(False, STILL)
    assert scene.shown() == []


def test_other_settings_remove_what_was_made_and_what_is_under_way(scene: FakeScene) -> None:
    lock = threading.RLock()
    layer: TimedLayer

    def make(t: int) -> Any:
        if not scene.nodes:  # the settings change while the first is made
            layer.settings_changed()
        return scene.add_thing(f"/{t}/{len(scene.nodes)}", visible=False)

    layer = TimedLayer("thing", "thing", lock, make, 2, on=True)
    work(layer, STILL)
    assert [node.removed for node in scene.nodes] == [True, False, False]


def test_of_a_long_recording_what_is_nearest_is_kept(
    timed: TimedLayer, scene: FakeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splashbench.viewer.layers.MOST_NODES", 3)
    assert work(timed, STILL) == 3
    moment = Moment(4, False)
    timed.show(moment)
    assert work(timed, moment) == 1
    assert [node.name for node in scene.nodes if not node.removed] == ["/1", "/2", "/4"]
    assert scene.shown() == ["/4"]
    assert timed.loading is None


def test_a_fixed_layer_is_made_when_it_is_first_wanted(scene: FakeScene) -> None:
    layer = FixedLayer("grid", "grid", threading.RLock(), lambda: [scene.add_grid("/grid", visible=False)])
    assert work(layer, STILL) == 0
    layer.switch(True, STILL)
    assert work(layer, STILL) == 1
    assert scene.shown() == ["/grid"]
    layer.switch(False, STILL)
    assert scene.shown() == []


def test_what_failed_stays_off(timed: TimedLayer) -> None:
    timed.fail("the file is gone", STILL)
    timed.switch(True, STILL)
    assert not timed.on
    assert work(timed, STILL) == 0


# The liquid's Gaussians.


def test_one_at_a_time_exchanges_a_group_of_one_size(server: FakeServer, made_up: MadeUp) -> None:
    layer = splats(server, made_up)
    sizes = set()
    for t in (0, 1, 3):
        assert work(layer, Moment(t, True)) == 1
        (node,) = server.scene.nodes
        sizes.add(len(node.content["centers"]))
        assert node.content["centers"][0, 0] * node.scale == pytest.approx(made_up.gaussians(t).means[0, 0], abs=1e-6)
    assert len(sizes) == 1
    assert server.scene.shown() == ["/liquid/shown"]


def test_all_ahead_sends_each_once_and_then_only_toggles(server: FakeServer, made_up: MadeUp) -> None:
    layer = splats(server, made_up)
    layer.set_send_ahead(True, PLAYING)
    assert work(layer, Moment(1, True)) == 4
    assert made_up.asked == [1, 2, 3, 0]
    for t in (2, 3, 0, 1):
        moment = Moment(t, True)
        layer.show(moment)
        assert server.scene.shown() == [f"/liquid/timestep {t}"]
        assert work(layer, moment) == 0
    assert all(node.sent == 1 for node in server.scene.nodes)


def test_a_large_model_is_thinned_while_it_plays_and_whole_at_rest(server: FakeServer, made_up: MadeUp) -> None:
    layer = splats(server, made_up, budget=4 * 10)
    layer.set_send_ahead(True, PLAYING)
    work(layer, PLAYING)
    assert [len(node.content["centers"]) for node in server.scene.nodes] == [10] * 4
    assert f"10 of up to {NUMBER} are shown" in layer.remark
    assert server.scene.shown() == ["/liquid/timestep 0"]
    layer.show(STILL)
    assert server.scene.shown() == ["/liquid/timestep 0"]
    assert work(layer, STILL) == 1
    assert server.scene.shown() == ["/liquid/shown"]
    opacities = server.scene.named("/liquid/shown").content["opacities"]
    assert (opacities > 0).sum() == NUMBER
    layer.show(Moment(1, True))
    assert server.scene.shown() == ["/liquid/timestep 1"]


def test_what_is_too_much_at_once_is_said(server: FakeServer, made_up: MadeUp, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splashbench.viewer.splat_layer.MOST_AT_ONCE", 20)
    layer = splats(server, made_up, budget=4 * 10)
    layer.set_send_ahead(True, PLAYING)
    work(layer, PLAYING)
    assert layer.remark == f"While it plays, 10 of up to {NUMBER} are shown; paused, at most 20."
    rich = splats(FakeServer(), made_up, budget=4 * NUMBER)  # type: ignore[arg-type]
    rich.set_send_ahead(True, PLAYING)
    work(rich, PLAYING)
    assert rich.remark.startswith(f"While it plays, 20 of up to {NUMBER} are shown")


def test_what_is_read_while_the_worker_writes_is_locked(stage: Stage) -> None:
    stage.layers["liquid"].set_send_ahead(True, STILL)  # type: ignore[attr-defined]
    finish(stage)
    reads: list[Any] = [
        lambda: stage.layers["liquid"].loading,
        lambda: stage.layers["liquid"].remark,
        lambda: stage.layers["cameras"].loading,
        lambda: stage._show_ground(True),
    ]
    for read in reads:
        reader = threading.Thread(target=read)
        with stage._lock:
            reader.start()
            reader.join(0.1)
            assert reader.is_alive()
        reader.join(10)
        assert not reader.is_alive()


def test_the_worker_does_not_bring_an_earlier_moment_back(stage: Stage) -> None:
    worker = threading.Thread(target=stage.done)
    with stage._lock:
        worker.start()
        worker.join(0.1)
        stage.show(Moment(2, True))
    worker.join(10)
    assert stage.moment == Moment(2, True)


def test_a_model_within_the_budget_is_whole_and_nothing_is_said(server: FakeServer, made_up: MadeUp) -> None:
    layer = splats(server, made_up, budget=4 * NUMBER)
    layer.set_send_ahead(True, PLAYING)
    work(layer, PLAYING)
    assert work(layer, STILL) == 0
    assert layer.remark == ""


def test_a_recording_of_too_many_timesteps_is_sent_one_at_a_time(
    server: FakeServer, made_up: MadeUp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("splashbench.viewer.splat_layer.MOST_NODES", 3)
    layer = splats(server, made_up)
    layer.set_send_ahead(True, STILL)
    assert work(layer, STILL) == 1
    assert server.scene.shown() == ["/liquid/shown"]


def test_one_at_a_time_again_takes_the_others_away(server: FakeServer, made_up: MadeUp) -> None:
    layer = splats(server, made_up)
    layer.set_send_ahead(True, STILL)
    work(layer, STILL)
    layer.set_send_ahead(False, STILL)
    work(layer, STILL)
    assert [node.name for node in server.scene.nodes if not node.removed] == ["/liquid/shown"]
    assert server.scene.shown() == ["/liquid/shown"]


def test_from_farther_off_it_is_made_anew_and_merged(server: FakeServer, made_up: MadeUp) -> None:
    layer = splats(server, made_up)
    layer.set_send_ahead(True, STILL)
    work(layer, STILL)
    layer.look_from(Lookout(np.array([0.0, 0.0, 1.1]), 1e-5))
    assert work(layer, STILL) == 0  # hardly farther
    layer.look_from(Lookout(np.array([0.0, 0.0, 10.0]), 1e-2))
    assert work(layer, STILL) == 4
    assert all(len(node.content["centers"]) < NUMBER for node in server.scene.nodes)
    assert f"{NUMBER} Gaussians are merged to" in layer.remark
    assert server.scene.shown() == ["/liquid/timestep 0"]


def test_a_timestep_without_liquid_is_one_invisible_gaussian(server: FakeServer) -> None:
    empty = MadeUp(number=0)
    layer = splats(server, empty)
    layer.set_send_ahead(True, STILL)
    work(layer, STILL)
    assert [node.content["opacities"].tolist() for node in server.scene.nodes] == [[[0]]] * 4


# A stage: all layers of an exhibit.


@pytest.fixture
def stage(server: FakeServer, made_up: MadeUp) -> Stage:
    extent = Extent(np.full(3, -0.2), np.full(3, 0.2))
    stage = Stage(server, made_up, "/exhibit 0", lambda client, name: None, NEAR, extent)
    stage.show(STILL)
    return stage


def finish(stage: Stage) -> None:
    """Do all that is to do, as the worker does."""
    for _ in range(200):
        jobs = stage.jobs(urgent=True) or stage.jobs(urgent=False)
        if not jobs:
            return
        jobs[0][1]()
        stage.done()
    raise AssertionError("it never comes to an end")


def shown(server: FakeServer) -> set[str]:
    return {name.removeprefix("/exhibit 0/") for name in server.scene.shown()} - {"/exhibit 0"}


def test_a_stage_shows_what_there_is(stage: Stage, server: FakeServer) -> None:
    assert list(stage.layers) == [
        *("liquid", "background", "particles", "surface", "cut", "velocity", "picture", "cameras", "grid")
    ]
    finish(stage)
    cameras = {"cameras/1", "cameras/1 name", "cameras/2", "cameras/2 name"}
    assert shown(server) == {"liquid/shown", "background", "grid", "grid size"} | cameras
    assert server.scene.background.tolist() == [[[200, 150, 100]]]  # what shows through the gaps


@pytest.mark.parametrize("name", ["particles", "surface", "velocity"])
def test_timed_layers_follow_the_clock(stage: Stage, server: FakeServer, name: str) -> None:
    stage.switch(name, True)
    finish(stage)
    for t in (0, 2, 1):
        stage.show(Moment(t, True))
        assert f"{name}/timestep {t}" in shown(server)
        assert sum(node.startswith(f"{name}/") for node in shown(server)) == 1
    stage.switch(name, False)
    assert not any(node.startswith(f"{name}/") for node in shown(server))


def test_the_photographs_are_of_the_timestep(stage: Stage, server: FakeServer) -> None:
    finish(stage)
    for t in (0, 3, 1):
        stage.show(Moment(t, True))
        for name in ("1", "2"):
            assert server.scene.named(f"/exhibit 0/cameras/{name}").image[0, 0, 0] == 10 * t + int(name)


def test_photographs_of_a_long_recording_are_not_all_kept(stage: Stage, server: FakeServer) -> None:
    layer = stage.layers["cameras"]
    layer._most = 2  # type: ignore[attr-defined]
    finish(stage)
    assert sorted(layer._small) == [0, 1]  # type: ignore[attr-defined]
    assert layer.loading is None  # type: ignore[attr-defined]
    stage.show(Moment(3, False))
    finish(stage)
    assert sorted(layer._small) == [1, 3]  # type: ignore[attr-defined]
    assert server.scene.named("/exhibit 0/cameras/2").image[0, 0, 0] == 32


def test_cameras_are_away_while_somebody_looks_through_one(stage: Stage, server: FakeServer) -> None:
    finish(stage)
    stage.look_through(True)
    stage.show(Moment(1, True))
    assert not any(node.startswith("cameras/") for node in shown(server))
    stage.look_through(False)
    assert "cameras/2" in shown(server)


def test_particles_take_other_colours(stage: Stage, server: FakeServer) -> None:
    stage.switch("particles", True)
    finish(stage)
    by_speed = server.scene.named("/exhibit 0/particles/timestep 0").content["colors"]
    stage.set(measure="height")
    finish(stage)
    by_height = server.scene.named("/exhibit 0/particles/timestep 0").content["colors"]
    assert (by_speed == by_speed[0]).all()  # all move alike
    assert len(np.unique(by_height, axis=0)) > 10


def test_the_cut_moves_with_its_slider_and_the_clock(stage: Stage, server: FakeServer) -> None:
    stage.switch("cut", True)
    finish(stage)
    place = server.scene.named("/exhibit 0/cut").content["position"].copy()
    assert place[2] == pytest.approx(-0.4 + 0.5 * 19 * 0.05)  # across z, where the cameras are
    stage.set(axis=0, share=0.25)
    finish(stage)
    assert server.scene.named("/exhibit 0/cut").content["position"][0] == pytest.approx(-0.4 + 0.25 * 19 * 0.05)
    stage.show(Moment(2, False))
    assert "cut" not in shown(server)  # of another time
    finish(stage)
    assert "cut" in shown(server)


def test_arrows_are_the_way_of_some_time(stage: Stage, server: FakeServer) -> None:
    stage.switch("velocity", True)
    finish(stage)
    arrows = server.scene.named("/exhibit 0/velocity/timestep 1").content["points"]
    assert len(arrows) == 27
    seconds = float(arrows[0, 1, 0] - arrows[0, 0, 0])  # at one unit a second along x
    assert f"the way of {seconds:.2g} s" in " ".join(stage.remarks())
    np.testing.assert_allclose(arrows[:, 1, 1:], arrows[:, 0, 1:], atol=1e-6)


def test_the_surface_is_where_the_distance_is_0(stage: Stage, server: FakeServer) -> None:
    stage.switch("surface", True)
    finish(stage)
    vertices = server.scene.named("/exhibit 0/surface/timestep 2").content["vertices"]
    radii = np.linalg.norm(vertices - [0.3, 0, 0], axis=1)
    np.testing.assert_allclose(radii, 0.2, atol=0.01)


def test_every_other_node_has_the_same_surface(made_up: MadeUp) -> None:
    whole = made_up.distance(0)
    half = coarser(whole, 2)
    assert half.voxel == 2 * whole.voxel
    np.testing.assert_array_equal(half.phi, whole.phi[:, ::2, ::2, ::2])
    assert coarser(whole, 1) is whole


def test_a_layer_that_fails_leaves_the_others(
    stage: Stage, server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(t: int) -> None:
        raise SplashbenchError("geometry.npz is damaged; write it again")

    monkeypatch.setattr(stage.exhibit, "distance", broken)
    stage.switch("surface", True)
    for layer, job in stage.jobs(urgent=True):
        try:
            job()
        except SplashbenchError as error:
            layer.fail(str(error), stage.moment)
    finish(stage)
    assert "liquid/shown" in shown(server)
    assert "The layer surface cannot be shown: geometry.npz is damaged; write it again" in stage.remarks()
    assert not stage.layers["surface"].on


def test_an_exhibit_that_is_not_chosen_is_away(stage: Stage, server: FakeServer) -> None:
    finish(stage)
    stage.set_visible(False)
    assert "/exhibit 0" not in server.scene.shown()
    assert server.scene.background is None
