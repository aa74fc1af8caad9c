"""The fields of dataclasses in their docstrings: units, defaults and limits as they are checked."""

import dataclasses
import inspect
import pydoc
import re

import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError
from meshskin.core.field_docs import document_fields, field_docs
from meshskin.effects import NAMES, find
from meshskin.recording.log_map import StreamMap
from meshskin.scene import schema
from meshskin.scene.settings import Loop

PUBLIC = [getattr(ms, name) for name in ms.__all__ if inspect.isclass(getattr(ms, name))]
TABLES = [schema.SkinTable, schema.ArmTable, schema.SceneTable, *schema._SHAPES.values()]
CLASSES = {
    cls
    for cls in (*PUBLIC, *map(find, NAMES), *TABLES, schema._Mesh, Loop, StreamMap)
    if dataclasses.is_dataclass(cls)
}


@pytest.mark.parametrize("cls", sorted(CLASSES, key=lambda c: c.__name__), ids=lambda c: c.__name__)
def test_every_field_has_a_text(cls):
    assert not [field.name for field in field_docs(cls) if not field.text]


def test_help_shows_unit_default_and_limits():
    shown = re.sub(r"\x08.|\s+\|\s+", " ", pydoc.render_doc(ms.Belief))
    assert "disc_radius : float, m, above 0, at most 0.05, default 0.002" in shown
    assert "Radius of a taxel's disc, m." in shown
    assert "body : Body, required" in shown


@pytest.mark.parametrize("cls", [ms.Law, ms.Exploration, ms.Readout, ms.Material, ms.Indenter])
def test_stated_limits_are_those_that_are_checked(cls):
    for field in field_docs(cls):
        for word, bound in re.findall(r"(above|at least|at most) (\S+?)(?:,|$)", field.limits):
            step = 1e-3 * (abs(float(bound)) or 1.0)
            out = float(bound) + {"above": 0.0, "at least": -step, "at most": step}[word]
            size = 3 if field.kind.startswith("tuple") else None
            with pytest.raises(ConfigError, match=rf"{field.name} is out of range.*{word} "):
                cls(**{field.name: out if size is None else (out,) * size})


def test_a_class_without_source_keeps_its_docstring_and_lists_its_fields():
    made = document_fields(dataclasses.make_dataclass("Made", [("size", float, 2.0)]))
    assert "size : float, default 2.0" in made.__doc__
    assert document_fields(made) is made
    assert "Fields" not in (document_fields(int).__doc__ or "")
