import json

import numpy as np
import pytest
import torch
from safetensors import safe_open

from flowrec.core.errors import UsageError
from flowrec.stages.refine import weights
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.network import trained_network
from flowrec.stages.refine.network_inputs import NetworkInputs

pytest.importorskip("flowrec.bench.training", reason="flowrec.bench.training is not in the wheel")
from flowrec.bench.training.lessons import prepare, read_lesson
from flowrec.bench.training.train import Training, train, turn, turn_inputs

pytestmark = pytest.mark.slow("a bench, from the sources")


@pytest.fixture(scope="module")
def lessons(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lessons")
    return folder, list(prepare(folder, 8))


def test_a_short_training_lowers_the_error_on_lessons_it_has_not_seen(lessons, tmp_path):
    folder, _ = lessons
    out = tmp_path / "weights.safetensors"
    figures = train(folder, out, Training(lessons=8, steps=16, validate_every=8, learning_rate=4e-3, average_decay=0.8))
    assert figures["best"] < figures["before"]
    assert figures["loss"][-1] < figures["loss"][0]
    weights.read_weights(out, trained_network())
    assert json.loads(safe_open(out, "pt").metadata()["facts"])["kind"] == "pi_unet"
    assert out.stat().st_size < 3e6


def test_the_same_seed_trains_the_same_bytes(lessons, tmp_path):
    folder, _ = lessons
    for name in ("a.safetensors", "b.safetensors"):
        train(folder, tmp_path / name, Training("unet", lessons=8, steps=2, validate_every=2))
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


def test_a_vessel_case_is_not_taken_for_a_lesson(lessons, tmp_path):
    with np.load(lessons[1][0]) as data:
        np.savez(tmp_path / "case.npz", **{key: data[key] for key in data.files if not key.startswith("assumed_")})
    with pytest.raises(UsageError, match="not a lesson"):
        read_lesson(tmp_path / "case.npz")


def test_a_turned_scene_is_the_scene_of_the_turned_flow(lessons):
    lesson = read_lesson(lessons[1][0])
    seen = lesson.operator(np.random.default_rng(0))
    inputs = NetworkInputs.of([Case.of(lesson.assumed, seen, lesson.chip, cropped=False)])
    back = inputs
    for quarters, mirrored in ((1, False), (2, True), (0, True), (1, False)):
        back = turn_inputs(back, quarters, mirrored)
    assert torch.equal(back.velocity, inputs.velocity) and torch.equal(back.geodesic, inputs.geodesic)
    # A flow to the right over a quarter turn against the clock goes up: y points down.
    right = torch.tensor([1.0, 0.0])[None, :, None, None].expand(1, 2, 4, 4)
    assert turn(right, 1, False)[0, :, 0, 0].tolist() == [0.0, -1.0]
