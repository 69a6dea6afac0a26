"""The experiment files below a folder: those of the user, not what runs have filed."""

from __future__ import annotations

from torchmbd.study.file.config_index import QUESTION_MISSING, configs


def test_copies_that_runs_have_filed_are_not_listed(tmp_path):
    for name in (
        "arm.yaml",
        "more/crane.yml",
        "mlartifacts/f10/artifacts/config.yaml",
        ".torchmbd/x.yaml",
        "cluster/arm.yaml",
    ):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("# Which arm?\n" if "arm" in name else "model: x\n")
    result = {str(file.relative_to(tmp_path)): asked for file, asked in configs(tmp_path).items()}
    assert result == {"arm.yaml": "Which arm?", "cluster/arm.yaml": "Which arm?", "more/crane.yml": QUESTION_MISSING}
