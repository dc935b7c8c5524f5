"""One thread within a block, and nobody else notices: not other threads, and nothing afterwards."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import torch

import forcegp
from forcegp.models.prediction import Prediction
from forcegp.resources import one_thread
from random_data import random_data, table_system

SCRIPT = """
import threading, torch
from forcegp.resources import one_thread
torch.set_num_threads(3)
seen, entered, left = {}, threading.Event(), threading.Event()

def other():
    seen["other"] = torch.get_num_threads()
    torch.ones(100) @ torch.ones(100)
    left.wait()
    seen["other later"] = torch.get_num_threads()

with one_thread():
    seen["inside"] = torch.get_num_threads()
    thread = threading.Thread(target=other); thread.start()
left.set(); thread.join()
seen["after"] = torch.get_num_threads()

def enter_and_leave_late(): # leaves after the main thread has left
    with one_thread():
        entered.set(); left.wait()

left.clear()
thread = threading.Thread(target=enter_and_leave_late)
with one_thread():
    thread.start(); entered.wait()
left.set(); thread.join()
seen["after both"] = torch.get_num_threads()
thread = threading.Thread(target=lambda: seen.update(new=torch.get_num_threads()))
thread.start(); thread.join()
print(seen)
"""


def test_other_threads_and_later_calls_keep_their_number() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    expected = {"inside": 1, "other": 3, "other later": 3, "after": 3, "after both": 3, "new": 3}
    assert ast.literal_eval(done.stdout) == expected


def test_threads_that_predict_get_the_same_numbers() -> None:
    system = table_system()
    model = forcegp.StructuredGP(system, "zero", noise=0.1).fit(
        random_data(system, 12), options=forcegp.models.LearningOptions(max_evaluations=2)
    )
    test = random_data(system, 20, seed=1)
    alone = model.predict(test.q, test.qd, test.tau)
    found: list[Prediction | BaseException] = []

    def predict() -> None:
        try:
            for _ in range(3):
                found.append(model.predict(test.q, test.qd, test.tau))
        except BaseException as error:
            found.append(error)

    threads = [threading.Thread(target=predict) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 12
    for prediction in found:
        assert isinstance(prediction, type(alone)), prediction
        assert torch.equal(prediction.mean, alone.mean)
        assert torch.equal(prediction.covariance, alone.covariance)  # type: ignore[arg-type]


CALLS = """
import tempfile, torch, forcegp
from pathlib import Path
from threadpoolctl import threadpool_info
from random_data import random_data, table_system
torch.set_num_threads(2)
system = table_system()
def counts():
    pools = sorted((p["filepath"], p["num_threads"]) for p in threadpool_info())
    return torch.get_num_threads(), torch.get_num_interop_threads(), torch.get_default_dtype(), pools
data, before = random_data(system, 12), counts()
few = forcegp.models.LearningOptions(max_evaluations=2)
for model in (forcegp.StructuredGP(system, noise=0.1), forcegp.models.IndependentGP(system, noise=0.1)):
    fit = model.fit(data, options=few)
    fit.predict(data.q, data.qd, data.tau)
    path = Path(tempfile.mkdtemp()) / "model"
    fit.save(path)
    loaded = forcegp.load_model(path)
    options = forcegp.rollout.RolloutOptions(dt=0.01, on_divergence="keep")
    loaded.rollout(data.q[0], 0.0 * data.qd[0], 0.0 * data.tau, duration=0.05, options=options)
forcegp.models.NeuralNetwork(system).fit(data, options=forcegp.models.minibatch.BatchOptions(epochs=1))
forcegp.evaluate(loaded, data)
after = counts()
assert [x for x in after[3] if x[0] in dict(before[3])] == before[3], (before, after)
print(after[:3] == before[:3])
"""


@pytest.mark.slow
def test_calls_of_the_library_leave_the_numbers_of_threads() -> None:
    paths = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": paths}
    done = subprocess.run(
        [sys.executable, "-c", CALLS], capture_output=True, text=True, check=False, env=environment
    )
    assert done.stdout.strip().endswith("True"), done.stderr[-2000:]


def test_an_error_inside_restores_the_number() -> None:
    before = torch.get_num_threads()
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    assert torch.get_num_threads() == before


def test_reading_mjcf_leaves_the_warning_handler_of_mujoco(tmp_path) -> None:
    mujoco = pytest.importorskip("mujoco")
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    handler = heard.append
    mujoco.set_mju_user_warning(handler)
    try:
        model = '<mujoco><worldbody><body><joint/><geom size="1"/></body></worldbody></mujoco>'
        (tmp_path / "arm.xml").write_text(model)
        threads = [
            threading.Thread(target=forcegp.load_robot, args=(tmp_path / "arm.xml",)) for _ in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert mujoco.get_mju_user_warning() is handler
    finally:
        mujoco.set_mju_user_warning(before)


INVERSES = """
import torch
from threadpoolctl import ThreadpoolController
from forcegp.gp.likelihood import cholesky_inverse_
from forcegp.resources import threads_of_pytorch
torch.set_num_threads(1)
libraries = ThreadpoolController().select(internal_api="openblas").lib_controllers
before = [x.num_threads for x in libraries]
with threads_of_pytorch():
    inside = [x.num_threads for x in libraries]
cholesky_inverse_(torch.eye(300, dtype=torch.float64))
print(dict(before=before, inside=inside, after=[x.num_threads for x in libraries]))
"""


def test_the_blas_of_scipy_takes_the_threads_of_pytorch() -> None:
    done = subprocess.run(
        [sys.executable, "-c", INVERSES],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "2"},
    )
    seen = ast.literal_eval(done.stdout)
    if 2 not in seen["before"]:
        pytest.skip("NumPy and SciPy come without OpenBLAS, or there is one processor")
    assert seen["inside"] == [1] * len(seen["before"])
    assert seen["after"] == seen["before"]


def test_a_fit_of_columns_to_few_samples_runs_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    system, seen = table_system(), list[int]()
    data = random_data(system, 60)
    few = forcegp.models.LearningOptions(max_evaluations=2)
    before = torch.get_num_threads()
    torch.set_num_threads(2)

    def progress(*_: object) -> None:
        seen.append(torch.get_num_threads())

    try:
        forcegp.StructuredGP(system).fit(data, progress=progress)
        columns, after = set(seen), torch.get_num_threads()
        seen.clear()
        forcegp.StructuredGP(system, "zero").fit(data[:12], options=few, progress=progress)
    finally:
        torch.set_num_threads(before)
    assert columns == {1} and after == 2
    assert set(seen) == {2}  # kernels factorise matrices that are large enough for threads
