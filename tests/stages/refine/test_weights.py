"""Trained weights: damaged files, what they are worth, and their name in a session."""

import pickle
from pathlib import Path

import pytest
import torch

from flowrec.core.errors import FlowError
from flowrec.stages.config import load_config
from flowrec.stages.refine import PiUnet, Refiner, weights
from flowrec.stages.refine.network import UNet, trained_network
from flowrec.store.session_writer import session_header


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


@pytest.mark.slow("fits a network from two starts")
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


def test_weights_that_are_a_pickle_are_refused_unopened(tmp_path):
    class Harm:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "owned",))

    path = tmp_path / "weights.safetensors"
    path.write_bytes(pickle.dumps(Harm()))
    with pytest.raises(FlowError, match="safetensors"):
        weights.read_weights(path, None)
    assert not (tmp_path / "owned").exists()
