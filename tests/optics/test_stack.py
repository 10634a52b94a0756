"""Stacks: the shipped ones are complete, impossible ones are refused."""

import math

import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError, StackError, UnknownNameError
from lsst.fringe_sim.optics import Layer, LayerStack, constant_medium, get_medium

GLASS = constant_medium("glass", 1.5)


def three(thickness_um: float = 1.0, **changes: float) -> tuple[Layer, ...]:
    return (
        Layer("top", GLASS, math.inf),
        Layer("film", GLASS, thickness_um, **changes),
        Layer("bottom", GLASS, math.inf),
    )


def test_e2v_stack_is_table_1_of_the_paper() -> None:
    stack = LayerStack.from_resource("e2v_ccd250")
    inner = [(layer.medium.name, layer.thickness_um) for layer in stack.layers[1:-1]]
    assert inner == [
        ("MgF2", 0.1221),
        ("Ta2O5", 0.0441),
        ("Si", 100.0),
        ("SiO2", 0.1),
        ("Si", 0.3),
        ("SiO2", 1.0),
        ("epoxy", 14.0),
        ("Si", 165.0),
    ]
    assert stack.layers[0].medium.name == "vacuum"
    assert stack.layers[-1].medium.name == "Si3N4"


@pytest.mark.parametrize("name", ["e2v_ccd250", "itl_sta3800c", "hsc_hamamatsu"])
def test_shipped_stacks_know_the_layers_that_models_name(name: str) -> None:
    stack = LayerStack.from_resource(name)
    assert {"detection", "adhesive", "support"} <= set(stack.names)
    indices = stack.indices(np.array([900.0, 960.0]), 183.0)
    assert indices.shape == (len(stack.layers), 2)
    for layer, index in zip(stack.layers, indices, strict=True):
        np.testing.assert_array_equal(index, layer.medium.index([900.0, 960.0], 183.0))


def test_changes_leave_the_original_alone() -> None:
    stack = LayerStack.from_resource("e2v_ccd250")
    thicker = stack.replace_layer("adhesive", thickness_um=17.5)
    assert (stack.thickness_um[7], thicker.thickness_um[7]) == (14.0, 17.5)
    assert stack.with_medium("adhesive", get_medium("SiO2")).layers[7].medium.name == "SiO2"
    longer = stack.with_inserted(Layer("gap", get_medium("air"), 0.5), before="support")
    assert longer.names.index("gap") == longer.names.index("support") - 1
    with pytest.raises(InputError, match="insert"):
        stack.with_inserted(Layer("gap", GLASS, 0.5), before="ambient")


@pytest.mark.parametrize("thickness", [-0.1, math.nan, math.inf, -math.inf])
def test_inner_thickness_must_be_finite(thickness: float) -> None:
    with pytest.raises(StackError, match="film"):
        LayerStack(three(thickness))


@pytest.mark.parametrize("changes", [{"roughness_nm": -1.0}, {"roughness_nm": math.nan}])
def test_roughness_must_be_finite(changes: dict[str, float]) -> None:
    with pytest.raises(StackError, match="roughness"):
        LayerStack(three(1.0, **changes))


def test_ends_must_be_infinite_and_names_unique() -> None:
    top, film, bottom = three()
    with pytest.raises(StackError, match="end layer"):
        LayerStack((film, top, bottom))
    with pytest.raises(StackError, match="every name once"):
        LayerStack((top, film, film, bottom))
    with pytest.raises(StackError, match="two or more"):
        LayerStack((top,))


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="e2v_ccd250"):
        LayerStack.from_resource("e2v_ccd25")
    with pytest.raises(UnknownNameError, match="adhesive"):
        LayerStack.from_resource("e2v_ccd250").position("adhesiv")
