import pickle

import numpy as np
import pytest
import torch

from flowrec.bench.lessons import prepare, read_lessons
from flowrec.bench.train import Training, train
from flowrec.config import load_config
from flowrec.errors import FlowError, UsageError
from flowrec.refine import PiUnet, Refiner, weights
from flowrec.refine.case import Case
from flowrec.refine.network import UNet, trained_network
from flowrec.refine.scene import Scene, turn
from flowrec.refine.sight import sight
from flowrec.session import session_header


@pytest.fixture(scope="module")
def lessons(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lessons")
    return folder, list(prepare(folder, 8))


def test_a_short_training_lowers_the_error_on_lessons_it_has_not_seen(lessons, tmp_path):
    folder, _ = lessons
    out = tmp_path / "weights.safetensors"
    figures = train(folder, out, Training(lessons=8, steps=16, judged_every=8, learning_rate=4e-3, averaged=0.8))
    assert figures["best"] < figures["before"]
    assert figures["loss"][-1] < figures["loss"][0]
    weights.read_weights(out, trained_network())
    assert weights.facts_of(out)["kind"] == "pi_unet"
    assert out.stat().st_size < 3e6


def test_the_same_seed_trains_the_same_bytes(lessons, tmp_path):
    folder, _ = lessons
    for name in ("a", "b"):
        train(folder, tmp_path / name, Training("unet", lessons=8, steps=2, judged_every=2))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_vessel_case_is_not_taken_for_a_lesson(lessons, tmp_path):
    with np.load(lessons[1][0]) as data:
        np.savez(tmp_path / "case.npz", **{key: data[key] for key in data.files if not key.startswith("assumed_")})
    with pytest.raises(UsageError, match="not a lesson"):
        read_lessons([tmp_path / "case.npz"])


def test_a_turned_scene_is_the_scene_of_the_turned_flow(lessons):
    lesson = read_lessons(lessons[1][:1])[0]
    seen = sight(lesson.observe(np.random.default_rng(0)), lesson.chip.mask, lesson.chip.um_per_px)
    scene = Scene.of([Case.of(lesson.assumed, seen, lesson.chip, cropped=False)])
    back = scene
    for quarters, mirrored in ((1, False), (2, True), (0, True), (1, False)):
        back = back.turned(quarters, mirrored)
    assert torch.equal(back.velocity, scene.velocity) and torch.equal(back.near, scene.near)
    # A flow to the right over a quarter turn against the clock goes up: y points down.
    right = torch.tensor([1.0, 0.0])[None, :, None, None].expand(1, 2, 4, 4)
    assert turn(right, 1, False)[0, :, 0, 0].tolist() == [0.0, -1.0]


class Trap:
    def __reduce__(self):
        return (pytest.fail, ("a checkpoint was executed",))


def damaged(kind, path):
    network = trained_network()
    weights.write_weights(path, UNet(8) if kind == "other" else network, {})
    data = path.read_bytes()
    if kind == "missing":
        path.unlink()
    elif kind == "pickle":
        path.write_bytes(pickle.dumps(Trap()))
    elif kind == "torch":
        torch.save({"a": Trap()}, path)
    elif kind == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "nan":
        with torch.no_grad():
            next(network.parameters()).fill_(float("nan"))
        weights.write_weights(path, network, {})


@pytest.mark.parametrize("kind", ["missing", "pickle", "torch", "cut", "other", "nan"])
def test_weights_that_do_not_fit_are_one_clear_line(kind, tmp_path, monkeypatch, twin):
    path = tmp_path / "pi_unet.safetensors"
    damaged(kind, path)
    monkeypatch.setitem(weights.SHIPPED, "vessels", path)
    case = twin()
    with pytest.raises(FlowError) as caught:
        Refiner("pi_unet", pi_unet=PiUnet(start="fvm")).refine(case.assumed, case.observations, case.chip, case.solver)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_the_shipped_weights_beat_a_cold_start_and_the_finish_beats_both(twin):
    case = twin()

    def error(**settings):
        refiner = Refiner("pi_unet", pi_unet=PiUnet(start="fvm", **settings))
        return case.error(refiner.refine(case.assumed, case.observations, case.chip, case.solver))

    warm, cold = error(finish="none", iterations=3), error(finish="none", weights="none", iterations=3)
    assert warm < cold
    assert error() < 0.5 * warm


def test_a_session_names_the_weights_that_its_flow_came_from(twin):
    def facts(*sets):
        return session_header(load_config(None, ["refine.method=pi_unet", *sets]), twin().chip).provenance

    assert facts("refine.pi_unet.start=fvm")["weights.pi_unet"] == weights.sha256(weights.SHIPPED["vessels"])
    assert "weights.pi_unet" not in facts("refine.pi_unet.weights=none", "refine.pi_unet.start=fvm")
