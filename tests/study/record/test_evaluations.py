"""The store of evaluations: what was computed is read back bit for bit, survives kill -9 and waits for a full disk."""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.refused import warned
from torchmbd.errors import MbdError
from torchmbd.optimization import Evaluation
from torchmbd.optimization.cache import CachedProblem
from torchmbd.study.record.evaluations import Evaluations

X = np.array([[0.1, np.pi], [-0.0, 1e-300], [2.0, 3.0]])


def computed(X, gradients):
    """A value that is known, with numbers that no decimal notation keeps."""
    return [
        Evaluation(x @ x / 3, x[:1] / 7, x / 3, np.outer([1.0], x) / 9)
        if gradients
        else Evaluation(x @ x / 3, x[:1] / 7)
        for x in X
    ]


@pytest.mark.parametrize("gradients", [True, False])
def test_evaluations_come_back_bit_for_bit(tmp_path, gradients):
    store = Evaluations(tmp_path / "e.db", "p")
    store.keep(X, gradients, computed(X, gradients))
    store.close()
    again = Evaluations(tmp_path / "e.db", "p")
    for result, expected in zip(again.find(X, gradients), computed(X, gradients), strict=True):
        assert result is not None
        assert result.objective == expected.objective
        assert_array_equal(result.constraints, expected.constraints)
        assert result.differentiated is gradients
        if gradients:
            assert_array_equal(result.objective_gradient, expected.objective_gradient)
            assert_array_equal(result.constraint_gradients, expected.constraint_gradients)
    assert again.find(X, not gradients) == [None] * 3
    assert again.find(X + 1e-15, gradients)[0] is None
    assert Evaluations(tmp_path / "e.db", "other").find(X, gradients) == [None] * 3


def test_a_failed_evaluation_is_known_with_its_reason(tmp_path):
    store = Evaluations(tmp_path / "e.db", "p")
    store.keep(X[:1], True, [Evaluation.failure("failed: not finite", 2)])
    (result,) = store.find(X[:1], True)
    assert result is not None
    assert result.status == "failed: not finite"
    assert np.isnan(result.constraints).tolist() == [True, True]
    assert not result.differentiated


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("numbers", lambda numbers: np.array([3.0]).tobytes() + numbers[8:]),
        ("numbers", lambda numbers: numbers[:-8]),
        ("numbers", lambda numbers: b""),
        ("numbers", lambda numbers: "text"),
        ("status", lambda status: "failed: by hand"),
        ("m", lambda m: 0),
        ("design", lambda design: X[2].tobytes()),
        ("problem", lambda problem: "q"),
    ],
)
def test_an_altered_row_is_reported_and_evaluated_again(tmp_path, column, value):
    store = Evaluations(tmp_path / "e.db", "p")
    store.keep(X[:2], True, computed(X[:2], True))
    (old,) = store._base.execute(f"select {column} from evaluations where design = ?", (X[1].tobytes(),)).fetchone()
    with store._base:
        change = f"update evaluations set {column} = ? where design = ?"
        store._base.execute(change, (value(old), X[1].tobytes()))
    again = Evaluations(tmp_path / "e.db", "q" if column == "problem" else "p")
    asked = X[2:] if column == "design" else X[1:2]
    with warned("e.db", "altered"):
        assert again.find(asked, True) == [None]
    again.keep(asked, True, computed(asked, True))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (result,) = again.find(asked, True)
    assert result is not None
    assert result.objective == computed(asked, True)[0].objective


def test_an_altered_row_is_in_no_picture(tmp_path):
    store = Evaluations(tmp_path / "e.db", "p")
    store.keep(X, True, computed(X, True))
    designs, values = store.visited(2)
    assert {tuple(x): y for x, y in zip(designs, values, strict=True)} == {tuple(x): x @ x / 3 for x in X}
    with store._base:
        store._base.execute("update evaluations set status = 'failed' where design = ?", (X[0].tobytes(),))
    with warned("altered"):
        assert len(store.visited(2)[0]) == 2


def test_a_store_that_is_damaged_is_named(tmp_path):
    """Pages overwritten, as by a failing disk."""
    store = Evaluations(tmp_path / "e.db", "p")
    many = np.random.default_rng(1).normal(size=(500, 2))
    store.keep(many, True, computed(many, True))
    store.close()
    data = bytearray((tmp_path / "e.db").read_bytes())
    data[4096:] = b"\xff" * (len(data) - 4096)
    (tmp_path / "e.db").write_bytes(data)
    with pytest.raises(MbdError, match=r"e\.db cannot be read"):
        Evaluations(tmp_path / "e.db", "p").find(many, True)


def test_only_the_unknown_is_computed(tmp_path):
    problem = SimpleNamespace(names=["a", "b"], start=X[0], lower=X[0], upper=X[0], equalities=[], period=[0, 0])
    asked, heard = [], []

    def compute(X, gradients):
        asked.append(X)
        return computed(X, gradients)

    store = Evaluations(tmp_path / "e.db", "p")
    source = SimpleNamespace(evaluate=compute)
    cached = CachedProblem(problem, store, source, lambda X, evaluations: heard.append(len(evaluations)))
    cached.evaluate(X[:1], True)
    values = cached.evaluate(X, True)
    assert [len(x) for x in asked] == [1, 2]
    assert_array_equal(asked[1], X[1:])
    assert [v.objective for v in values] == [x @ x / 3 for x in X]
    assert heard == [1, 3]
    assert (cached.hits, cached.computed) == (1, 3)
    store.forget()
    assert store.count() == 0


def test_what_a_full_disk_refuses_is_kept_and_written_later(tmp_path):
    """A real SQLITE_FULL: the file may not grow beyond its pages."""
    store = Evaluations(tmp_path / "e.db", "p")
    pages = store._base.execute("pragma page_count").fetchone()[0]
    store._base.execute(f"pragma max_page_count={pages + 1}")
    many = np.random.default_rng(1).normal(size=(2000, 2))
    store.keep(many, True, computed(many, True))
    assert store.trouble is not None
    assert "full" in store.trouble
    assert all(store.find(many, True))
    assert store.count() == 0
    store._base.execute("pragma max_page_count=100000")
    store.keep(X, True, computed(X, True))
    assert store.trouble is None
    assert store.count() == 2003


def test_a_store_that_cannot_be_opened_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(MbdError, match="cannot be opened"):
        Evaluations(tmp_path / "file" / "e.db", "p")


def _die_while_writing(file):
    store = Evaluations(file, "p")
    store.keep(X, True, computed(X, True))
    with store._base:  # in the middle of a transaction
        store._base.execute("insert into evaluations values ('p', x'00', 1, 0, 'ok', x'00')")
        os.kill(os.getpid(), signal.SIGKILL)


def test_kill_in_the_middle_of_a_batch_costs_that_batch_alone(tmp_path):
    process = multiprocessing.get_context("fork").Process(target=_die_while_writing, args=(tmp_path / "e.db",))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    store = Evaluations(tmp_path / "e.db", "p")
    assert store.count() == 3
    assert all(store.find(X, True))
