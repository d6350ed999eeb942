"""What is exported for Foxglove, PlotJuggler and rerun: channels, schemas, layouts; read back by other programs."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import equimus_ctrl as eq
from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.errors import ConfigError, RecordingError
from equimus_ctrl.models.model import model_to_dict
from equimus_ctrl.workflow import recorded_models

pytest.importorskip("mcap", reason="mcap is not installed: pip install 'equimus-ctrl[logs]'")

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"
XML, RUNS = EXAMPLES / "pendulum.xml", EXAMPLES / "pendulum"
CHANNELS = {
    "command", "measured/position", "nominal/position", "nominal/residual", "augmented/position", "augmented/residual",
}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trials of the pendulum, predicted by it and by one with friction."""
    folder = tmp_path_factory.mktemp("export")
    model = eq.load_model(XML)
    augmented = eq.Model(model.robot, (eq.CoulombFriction("hinge", friction=0.05),))
    path = folder / "runs.mcap"
    files = eq.export_recordings([RUNS / "run_1.csv", RUNS / "run_2.csv"], path, model, augmented=augmented)
    assert [file.name for file in files] == ["runs.mcap", "runs.foxglove.json", "runs.plotjuggler.xml"]
    return path


def test_mcap_reads_every_channel_with_its_schema(written: Path) -> None:
    from mcap.reader import make_reader

    with written.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        topics = {own.topic: summary.schemas[own.schema_id] for own in summary.channels.values()}
        assert set(topics) == {f"/{run}/{own}" for run in ("run_1", "run_2") for own in CHANNELS}
        values: dict[str, list[float]] = {}
        times = []
        for schema, channel, message in reader.iter_messages():
            own = json.loads(message.data)
            assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
            described = json.loads(schema.data)
            assert set(own) == set(described["required"]) == set(described["properties"])
            times.append(message.log_time)
            if channel.topic.startswith("/run_1/"):
                values.setdefault(channel.topic, []).append(own["motor" if "command" in channel.topic else "hinge"])
    assert times == sorted(times)
    assert json.loads(topics["/run_1/measured/position"].data)["properties"]["hinge"]["description"] == "[rad]"
    assert json.loads(topics["/run_1/command"].data)["properties"]["motor"]["description"] == "[N·m]"
    trial = eq.read_recording(RUNS / "run_1.csv", eq.load_model(XML))
    np.testing.assert_array_equal(values["/run_1/command"], trial.command[:, 0])
    np.testing.assert_array_equal(values["/run_1/measured/position"], trial.position[:, 0])
    predicted = eq.predict(eq.load_model(XML), trial)[:, 0]
    np.testing.assert_allclose(values["/run_1/nominal/position"], predicted, atol=1e-12)
    np.testing.assert_array_equal(
        values["/run_1/nominal/residual"], trial.position[:, 0] - values["/run_1/nominal/position"]
    )
    assert not np.allclose(values["/run_1/augmented/residual"], values["/run_1/nominal/residual"])


def test_its_trials_come_back_bit_for_bit(written: Path) -> None:
    model = eq.load_model(XML)
    for name in ("run_1", "run_2"):
        found = eq.read_recording(written, model, trial=name)
        own = eq.read_recording(RUNS / f"{name}.csv", model)
        for key in ("time", "command", "position"):
            np.testing.assert_array_equal(getattr(found, key), getattr(own, key))
        assert dict(found.notes) == dict(own.notes)
    with pytest.raises(RecordingError, match=r"there is no trial None \(known: run_1, run_2\)"):
        eq.read_recording(written, model)


def test_layouts_show_what_is_in_the_file(written: Path) -> None:
    from mcap.reader import make_reader

    with written.open("rb") as file:
        fields = {
            (channel.topic, key)
            for _, channel, message in make_reader(file).iter_messages()
            for key in json.loads(message.data)
            if key != "time"
        }
    layout = json.loads(written.with_suffix(".foxglove.json").read_text())
    panels = layout["configById"]
    plots = {name: own for name, own in panels.items() if name.startswith("Plot!")}
    shown = {tuple(path["value"].split(".")) for own in plots.values() for path in own["paths"]}
    assert shown == fields
    used: list[str] = []

    def walk(node: object) -> None:
        if isinstance(node, str):
            used.append(node)
        elif isinstance(node, dict):
            walk(node["first"])
            walk(node["second"])

    tabs = panels[layout["layout"]]["tabs"]
    for tab in tabs:
        walk(tab["layout"])
    assert sorted(used) == sorted(plots) and [tab["title"] for tab in tabs] == ["run_1", "run_2"]
    root = ElementTree.parse(written.with_suffix(".plotjuggler.xml")).getroot()
    assert {own.get("name") for own in root.iter("curve")} == {f"{topic}/{key}" for topic, key in fields}
    for splitter in root.iter("DockSplitter"):
        count = len(splitter.findall("DockArea"))
        assert splitter.get("count") == str(count) == str(len((splitter.get("sizes") or "").split(";")))


def test_fields_with_odd_names_are_quoted(tmp_path: Path) -> None:
    times = np.arange(10) * 0.1
    odd = eq.Recording("a b", times, times[:, None], times[:, None], ("drive-1",), ("joint.x",))
    from equimus_ctrl.recordings import Exported
    from equimus_ctrl.recordings.layouts import foxglove

    panels = foxglove([Exported(odd)])["configById"]
    assert panels["Plot!1"]["paths"][0]["value"] == '/a_b/measured/position."joint.x"'
    assert panels["Plot!2"]["paths"][0]["value"] == '/a_b/command."drive-1"'
    eq.write_recording(tmp_path / "a b.mcap", odd)
    found = eq.read_recording(tmp_path / "a b.mcap")
    assert (found.joints, found.actuators) == (("joint.x",), ("drive-1",))


def test_models_of_a_diagnosis_predict_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = eq.load_model(XML)
    refitted = eq.Model(model.robot.with_parameters({"hinge.armature": 0.004}))
    augmented = eq.Model(refitted.robot, (eq.CoulombFriction("hinge", friction=0.05),))
    record = tmp_path / "report" / "record.json"
    record.parent.mkdir()
    record.write_text(
        json.dumps({"models": {"refitted": model_to_dict(refitted), "corrected": model_to_dict(augmented)}})
    )
    found = recorded_models(record.parent, model, XML)
    assert found["refitted"].parameters() == refitted.parameters()
    assert found["augmented"].parameters() == augmented.parameters()
    given = ["recordings", "export", str(RUNS / "run_1.csv"), "--model", str(XML), "-o", str(tmp_path / "run.mcap")]
    assert main([*given, "--diagnosis", str(record), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["files"]) == 3
    assert main(given) == 2 and "run.mcap: is already there" not in (said := capsys.readouterr().err)
    assert "run.mcap: is there already; expected another name, or --force to replace it" in said
    assert main([*given, "--force"]) == 0
    record.write_text("{}")
    with pytest.raises(ConfigError, match="has no models in it, expected the record of a diagnosis"):
        recorded_models(record, model, XML)


def test_the_record_of_a_diagnosis_holds_its_models() -> None:
    """As ``recorded_models`` takes them."""
    model = eq.load_model(XML)

    class Held:
        refitted = model
        corrected = eq.Model(model.robot, (eq.CoulombFriction("hinge", friction=0.05),))

    held = Diagnosis._models(Held())  # type: ignore[arg-type]
    assert held == {"refitted": model_to_dict(Held.refitted), "corrected": model_to_dict(Held.corrected)}


@pytest.mark.parametrize(
    ("name", "said"), [("runs.txt", "expected a name that ends in .mcap or .rrd"), ("a/b.mcap", "is no folder")]
)
def test_places_that_cannot_be_written_are_told_before_anything_is_simulated(
    name: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "a").write_text("a file")
    with pytest.raises(ConfigError, match=said):
        eq.export_recordings(RUNS, tmp_path / name, eq.load_model(XML))


def test_rosbags_reads_the_bags_that_are_written(tmp_path: Path) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
    model = eq.load_model(XML)
    (folder,) = eq.export_recordings(RUNS / "run_1.csv", tmp_path / "bags", model, ros2=True)
    with highlevel.AnyReader([folder]) as reader:
        counts = {own.topic: own.msgcount for own in reader.connections}
        rows = [reader.deserialize(raw, own.msgtype) for own, _, raw in reader.messages() if "residual" in own.topic]
    trial = eq.read_recording(RUNS / "run_1.csv", model)
    topics = ("/joint_states", "/commands", "/nominal/position", "/nominal/residual")
    assert counts == dict.fromkeys(topics, len(trial.time))
    predicted = eq.predict(model, trial)
    np.testing.assert_allclose([row.position[0] for row in rows], (trial.position - predicted)[:, 0], atol=1e-12)
    found = eq.read_recording(folder, model)
    np.testing.assert_array_equal(found.position, trial.position)
    np.testing.assert_array_equal(found.command, trial.command)
    np.testing.assert_allclose(found.time, trial.time - trial.time[0], atol=2e-9)
    with pytest.raises(ConfigError, match="is there already"):
        eq.export_recordings(RUNS / "run_1.csv", tmp_path / "bags", model, ros2=True)


def test_rerun_reads_what_is_written_for_it(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed: pip install 'equimus-ctrl[rerun]'")
    (file,) = eq.export_recordings(RUNS / "run_1.csv", tmp_path / "run.rrd", eq.load_model(XML))
    data = file.read_bytes()
    assert data.startswith(b"RRF") and b"/run_1/nominal/residual/hinge" in data
