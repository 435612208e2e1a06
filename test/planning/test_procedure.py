"""Procedure files: what they hold, and what is refused with the goal and the field in the message."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from magnetosuture_thread.planning.procedure import parse_procedure, read_procedure
from magnetosuture_thread.settings.errors import ConfigurationError


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "procedure: got"),
        ({"goals": [{}], "speed": 1.0}, "procedure: got"),
        ({"goals": [{"gto": {}}]}, "did you mean go_to"),
        ({"goals": [{"go_to": {}, "wrap": {}}]}, "one kind of goal"),
        ({"goals": [{"go_to": {"position": [0.0, float("nan")]}}]}, "goals[0].go_to.position"),
        ({"goals": [{"go_to": {"position": [0.0, 0.0]}, "limits": {"speed": -1.0}}]}, "goals[0].limits.speed"),
        ({"goals": [{"wrap": {"around": "ring", "angle": -1.0}}]}, "goals[0].wrap.angle"),
        ({"goals": [{"wrap": {"around": "ring", "angle": 1.0, "sense": "up"}}]}, "goals[0].wrap.sense"),
        ({"goals": [{"pass_through": {"between": ["a", "a"], "direction": [1.0, 0.0]}}]}, "the names of two shapes"),
        ({"goals": [{"pass_through": {"between": ["a", "b"], "direction": [0.0, 0.0]}}]}, "not zero"),
        ({"goals": [{"tighten": {"toward": [0.0, 0.0]}}]}, "a tension or a clearance above 0"),
    ],
)
def test_what_is_no_procedure_is_refused(content: Any, message: str):
    with pytest.raises(ConfigurationError) as caught:
        parse_procedure(content, "bad", "bad.yaml")
    assert message in str(caught.value)


def test_a_file_that_is_not_there_is_refused_with_those_that_are(tmp_path: Path):
    with pytest.raises(ConfigurationError, match="one of dead_end, figure_eight, hernia, slalom"):
        read_procedure("hernai")
    with pytest.raises(ConfigurationError, match="YAML"):
        read_procedure(str(tmp_path / "none.yaml"))


def test_files_beside_a_procedure_are_found_from_any_folder(tmp_path: Path):
    (tmp_path / "lab.yaml").write_text("dish: {diameter: 0.05}\n", encoding="utf-8")
    file = tmp_path / "mine.yaml"
    file.write_text("{setup: dish_50mm, scene: lab.yaml, goals: [{withdraw: {}}]}\n", encoding="utf-8")
    procedure = read_procedure(str(file))
    assert (procedure.setup, procedure.scene) == ("dish_50mm", str(tmp_path / "lab.yaml"))
    file.write_text("{setup: dish_50mm, scene: other.yaml, goals: [{withdraw: {}}]}\n", encoding="utf-8")
    assert read_procedure(str(file)).scene == "other.yaml"  # from the working directory
