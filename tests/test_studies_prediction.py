"""Prediction errors, from a calibration file to table, plot and page."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from studies_synthetic import IDENTITY, part, run_cell, settings_of

from kerv_cli.base.errors import CheckpointError
from kerv_cli.base.files import read_json, sha256_of, write_json
from kerv_cli.base.settings import StudySettings
from kerv_cli.lab.plan import plan
from kerv_cli.lab.store import StudyStore
from kerv_cli.methods.artifacts import MadeFor
from kerv_cli.methods.calibration import Calibration, Demonstrations, save_calibration
from kerv_cli.methods.kinematics.prediction import FILTERS, Noise
from kerv_cli.report.prediction import (
    calibrated_targets,
    predicting_targets,
    prediction_figure,
    prediction_summary,
    prediction_table,
    read_predictions,
)
from kerv_cli.report.report import report
from kerv_cli.worlds.metaworld.spec import SPEC

DOFS = ("dx", "dy", "dz", "gripper")
STATUS = {"run": "r1", "workers": 1, "device_name": "chip"}


def errors(scale: float) -> dict[str, dict[str, list[float]]]:
    """Two tasks, two steps ahead; push is twice as hard, dz three times dx; the gripper is never wrong."""
    tasks = {"reach-v3": 1.0, "push-v3": 2.0}
    dofs = dict(zip(DOFS, (1.0, 2.0, 3.0, 0.0), strict=True))
    return {t: {d: [scale * a * b, 2 * scale * a * b] for d, b in dofs.items()} for t, a in tasks.items()}


def calibrate(results: Path, name: str = "made-here") -> Path:
    """A target folder and its calibration: linear is twice as good as hold, the Kalman filter four times."""
    write_json(results / "artifacts/target" / name / "target.json", {})
    path = results / "artifacts/calibration" / name / "calibration.json"
    noise = Noise((0.1,) * 4, (1.0,) * 4, (1.0,) * 4)
    calibration = Calibration(
        target=MadeFor("a" * 64, SPEC.actions, 2),
        demos=Demonstrations("d" * 64, {t: {"training": 9, "held_out": 1} for t in ("reach-v3", "push-v3")}),
        window=10,
        noise=dict.fromkeys(FILTERS, noise),
        errors={"hold": errors(0.1), "linear": errors(0.05), "kalman": errors(0.025)},
        variability={},
        provenance={"git_commit": "c0ffee"},
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    save_calibration(path, calibration)
    return path


def write_study(results: Path, name: str) -> None:
    """One method fills what was rejected."""
    settings = {"ar": settings_of("ar", episodes=1), "kerv": settings_of("kerv", 9, episodes=1)}
    for s in settings.values():
        s.policy.target = "made-here"
    settings["kerv"].rectifier = part("rectifier", "compensate")
    cells = plan(settings, ["reach-v3"], IDENTITY, baseline="ar")
    store = StudyStore(results, name)
    for cell in cells:
        store.write_cell(cell, run_cell(cell), STATUS)
    store.write_plan(StudySettings(name, name, "ar"), cells)


def test_the_table_has_every_error_beside_holds(tmp_path: Path) -> None:
    path = calibrate(tmp_path)
    predictions = read_predictions(tmp_path, "made-here")
    assert predictions is not None
    table = prediction_table(predictions)
    assert len(table) == 3 * 2 * 4 * 2
    key = ["predictor", "task", "dof", "steps_ahead"]
    assert not table.duplicated(key).any()
    row = table.set_index(key).loc[("kalman", "push-v3", "dz", 2)]
    assert row["error"] == pytest.approx(0.025 * 2 * 3 * 2)
    assert row["hold_error"] == pytest.approx(0.1 * 2 * 3 * 2)
    assert row["ratio_to_hold"] == pytest.approx(0.25)
    assert (row["window"], row["target"], row["held_out_episodes"]) == (10, "made-here", 1)
    assert row["calibration_sha256"] == sha256_of(path)
    assert (row["target_sha256"], row["demos_sha256"]) == ("a" * 64, "d" * 64)
    assert table[table["dof"] == "gripper"]["ratio_to_hold"].isna().all()


def test_summary_and_figure_average_position_over_tasks(tmp_path: Path) -> None:
    calibrate(tmp_path)
    predictions = read_predictions(tmp_path, "made-here")
    assert predictions is not None
    table = prediction_table(predictions)
    summary = prediction_summary(table).set_index("predictor")
    # (1 + 2 + 3) / 3 per DoF, (1 + 2) / 2 per task
    assert summary.loc["hold"].to_list() == ["0.3000", "0.6000"]
    assert summary.loc["kalman"].to_list() == ["0.0750 (25 %)", "0.1500 (25 %)"]
    ahead, by_task = prediction_figure("Prediction", table).axes
    lines = {line.get_label(): list(line.get_ydata()) for line in ahead.get_lines()}
    assert lines["linear"] == pytest.approx([0.15, 0.30])
    assert set(lines) == {"hold", "linear", "kalman"}
    assert [label.get_text() for label in by_task.get_yticklabels()] == ["reach-v3", "push-v3"]
    assert sorted(bar.get_width() for bar in by_task.patches)[-1] == pytest.approx(0.4)  # hold on push


def test_what_is_not_calibrated_has_no_errors(tmp_path: Path) -> None:
    assert read_predictions(tmp_path, "nobody") is None
    write_json(tmp_path / "artifacts/target/bare/target.json", {})
    assert read_predictions(tmp_path, "bare") is None
    assert calibrated_targets(tmp_path) == []


def test_a_damaged_calibration_is_named(tmp_path: Path) -> None:
    path = calibrate(tmp_path)
    for harm in ({"window": "ten"}, {"boundary": {"what": "ever"}}, {"format": 1}):
        write_json(path, {**read_json(path), **harm})
        with pytest.raises(CheckpointError, match=f"calibration.json is damaged: {next(iter(harm))}"):
            read_predictions(tmp_path, "made-here")
        calibrate(tmp_path)


def test_whose_methods_predict() -> None:
    def plain(kind: str = "drafter", rectifier: str = "reinfer", sources: list[str] | None = None) -> dict[str, object]:
        found: dict[str, object] = {"policy": {"target": "t"}, "proposer": {"kind": kind}}
        found["rectifier"] = {"kind": rectifier}
        return found | ({"prefill_draft": {"kind": "merged", "sources": sources}} if sources is not None else {})

    for predicts in (plain(rectifier="compensate"), plain("kalman"), plain("none", sources=["early", "hold"])):
        assert predicting_targets([predicts, predicts]) == ["t"]
    for does_not in (plain(), plain("none"), plain("none", sources=["early", "retrieval"])):
        assert predicting_targets([does_not]) == []


def test_the_page_shows_what_its_methods_use(tmp_path: Path) -> None:
    calibrate(tmp_path)
    write_study(tmp_path, "used")
    written = names(tmp_path, report(tmp_path, "used").files)
    assert {"report/tables/prediction_made-here.csv", "report/plots/prediction_made-here.png"} <= set(written)
    assert len(written) == len(set(written))
    page = (tmp_path / "studies/used/report.html").read_text(encoding="utf-8")
    assert "Prediction of the next actions, made-here" in page
    assert "0.0750 (25 %)" in page
    ids = [part.split('"')[0] for part in page.split(' id="')[1:]]
    assert len(ids) == len(set(ids))
    table = pd.read_csv(tmp_path / "report/tables/prediction_made-here.csv")
    assert list(table.columns[:6]) == ["target", "predictor", "task", "dof", "steps_ahead", "error"]


def test_without_a_study_every_calibration_is_reported(tmp_path: Path) -> None:
    calibrate(tmp_path)
    assert names(tmp_path, report(tmp_path).files) == [
        f"{folder}/prediction_made-here.{kind}"
        for folder, kind in (("report/tables", "csv"), ("report/plots", "png"), ("report/plots", "svg"))
    ]


def names(results: Path, written: list[Path]) -> list[str]:
    return [path.relative_to(results).as_posix() for path in written]
