"""The picture of a localisation shows what its table says."""

import numpy as np
import pytest

from flexplant import DofSet, plot
from flexplant.errors import ModelError
from flexplant.updating import AddedMass, Localisation


@pytest.fixture
def case():
    candidates = [AddedMass(f"{i}:z") for i in range(1, 4)]
    candidates.append(AddedMass({"1:z": 0.5, "3:z": 0.5}, name="between"))
    names = [q.name for q in candidates]
    xyz = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 2.0, 0.0]]
    found = Localisation(
        candidates=tuple(names),
        values=np.array([0.3, 0.2, np.nan, 0.1]),
        score=np.array([0.9, 0.895, 0.1, 0.4]),
        bic=np.array([10.0, 40.0, np.inf, 90.0]),
        chosen=("mass at 1:z",),
        chosen_values=np.array([0.3]),
        chosen_bic=10.0,
        nothing_bic=100.0,
    )
    return found, candidates, DofSet([1, 2, 3], ["z"] * 3, xyz)


def test_bars_and_plan(case):
    found, candidates, dofs = case
    ax = plot.localisation(found)
    assert [text.get_text() for text in ax.get_yticklabels()] == list(found.ranking)
    widths = sorted((bar.get_y(), bar.get_width()) for bar in ax.patches)
    assert [width for _, width in widths] == pytest.approx([90, 89.5, 40, 10])
    _, labels = ax.get_legend_handles_labels()
    assert labels == ["chosen", "rival", "other"]
    assert sum("alone" in text.get_text() for text in ax.texts) == 3
    plan = plot.localisation(found, candidates=candidates, dofs=dofs)
    dots, chosen, rival = plan.collections[:3]
    where = dict(
        zip(np.round(dots.get_array(), 1).tolist(), dots.get_offsets().tolist(), strict=True)
    )
    assert where[40.0] == [0.5, 1.0]
    assert chosen.get_offsets().tolist() == [[0.0, 0.0]]
    assert rival.get_offsets().tolist() == [[1.0, 0.0]]


def test_what_does_not_go_together_is_refused(case):
    found, candidates, dofs = case
    with pytest.raises(ModelError, match="needs both"):
        plot.localisation(found, candidates=candidates)
    with pytest.raises(ModelError, match="in its order"):
        plot.localisation(found, candidates=candidates[:2], dofs=dofs)


@pytest.mark.slow
def test_what_was_chosen_is_shown_though_a_dozen_explain_more_alone(case):
    """Two masses together: the second explains little by itself."""
    names = tuple(f"m{i}" for i in range(20))
    score = np.linspace(0.9, 0.1, 20)
    found = case[0].replace(
        candidates=names, values=score, score=score, bic=np.arange(20.0) * 10, chosen=("m0", "m17")
    )
    assert found.table.splitlines()[-2].startswith("m17")
    assert found.table.splitlines()[-2].endswith("chosen")
    assert found.table.splitlines()[-1] == "and 7 more"
    ax = plot.localisation(found)
    assert [text.get_text() for text in ax.get_yticklabels()][-1] == "m17"
