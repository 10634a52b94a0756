"""A sensor as a stack of plane layers between two half spaces."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import ComplexArray, FloatArray
from ..descriptions import Description, read_description
from ..errors import InputError, ResourceError, StackError, UnknownNameError, named_units, printable_name
from ..notebook import OneLine
from ..resources import list_resources, read_yaml
from .media import Medium, get_medium


@named_units
@dataclass(frozen=True, repr=False)
class Layer(OneLine):
    """One plane-parallel layer.

    Attributes
    ----------
    name : `str`
        What the layer is for: ``detection``, ``adhesive``, ``support``...
    medium : `Medium`
        What it is made of.
    thickness_um : `float`
        Thickness [µm]; infinite for the first and the last layer of a stack.
    roughness_nm : `float`
        Rms roughness of the interface on the side of the light [nm]; dephases the reflected and the
        transmitted wave there.
    """

    name: str
    medium: Medium
    thickness_um: float
    roughness_nm: float = 0.0
    thickness_spread_um: float = 0.0


@dataclass(frozen=True, repr=False)
class LayerStack(OneLine):
    """Layers in the order in which the light meets them.

    Attributes
    ----------
    layers : `tuple` [`Layer`, ...]
        From the ambient medium to the substrate; the two ends are infinite, all others finite.
    name : `str`
        Name of the stack.

    Raises
    ------
    StackError
        A finite end, an infinite, negative or NaN thickness inside, fewer than two layers, or a name twice.
    """

    layers: tuple[Layer, ...]
    name: str = "stack"

    def __post_init__(self) -> None:
        if len(self.layers) < 2:
            raise StackError("number of layers", len(self.layers), "two or more", source=self.name)
        names = [layer.name for layer in self.layers]
        for name in names:
            if names.count(name) > 1:
                raise StackError("layer name", name, "every name once", source=self.name)
        for end in (self.layers[0], self.layers[-1]):
            if end.thickness_um != math.inf:
                raise StackError(
                    f"thickness [um] of end layer {end.name}", end.thickness_um, "infinite", source=self.name
                )
        for layer in self.layers[1:-1]:
            if not (0.0 <= layer.thickness_um < math.inf):
                raise StackError(
                    f"thickness [um] of layer {layer.name}",
                    layer.thickness_um,
                    "finite and not negative",
                    source=self.name,
                )
        for layer in self.layers:
            if not (0.0 <= layer.roughness_nm < math.inf):
                raise StackError(
                    f"roughness [nm] of layer {layer.name}",
                    layer.roughness_nm,
                    "finite and not negative",
                    source=self.name,
                )
            inner = layer.thickness_um < math.inf
            if not (layer.thickness_spread_um >= 0.0 if inner else layer.thickness_spread_um == 0.0):
                raise StackError(
                    f"thickness spread [um] of layer {layer.name}",
                    layer.thickness_spread_um,
                    "not negative" if inner else "zero (a half space has no thickness)",
                    source=self.name,
                )

    @classmethod
    def from_resource(cls, name: str) -> LayerStack:
        """Stack shipped as ``data/stacks/<name>.yaml``.

        Raises
        ------
        UnknownNameError
            There is no such stack, or it names an unknown medium.
        """
        if f"{name}.yaml" not in list_resources("stacks"):
            known = [entry.removesuffix(".yaml") for entry in list_resources("stacks")]
            raise UnknownNameError("stack", name, known)
        content = read_yaml("stacks", f"{name}.yaml")
        for key in ("source", "doi", "licence", "layers"):
            if key not in content:
                raise ResourceError(f"data/stacks/{name}.yaml does not state its {key}")
        return cls._of(name, Description(content, f"stack {name}"), {})

    @classmethod
    def from_file(cls, path: str | Path, media: Mapping[str, Medium] | None = None) -> LayerStack:
        """Stack that a YAML file describes, laid out like the shipped ones; it is named after the file.

        ``media``: further media by name, as of `read_media`; they come before those that are shipped.

        Raises
        ------
        InputError
            The file is no such description.
        UnknownNameError
            It names a medium that there is not.
        """
        reader = Description(read_description(path, "stack"), str(path))
        name = printable_name("name of the stack", Path(path).stem)
        try:
            return cls._of(name, reader, media or {})
        except StackError as error:
            raise error.in_source(str(path)) from None

    @classmethod
    def _of(cls, name: str, reader: Description, media: Mapping[str, Medium]) -> LayerStack:
        layers = []
        for each in reader.sections("layers"):
            medium = each.text("medium")
            try:
                found = media[medium] if medium in media else get_medium(medium)
            except UnknownNameError as error:
                raise error.in_source(reader.source) from None
            thickness = each.number("thickness_um", low=0.0, high=math.inf)
            roughness, spread = (
                each.number(key, low=0.0, high=1e6, default=0.0)
                for key in ("roughness_nm", "thickness_spread_um")
            )
            layers.append(Layer(each.text("name"), found, thickness, roughness, spread))
        return cls(tuple(layers), name)

    @property
    def names(self) -> tuple[str, ...]:
        """Layer names, from the light inwards."""
        return tuple(layer.name for layer in self.layers)

    @property
    def thickness_um(self) -> FloatArray:
        """Thickness of every layer [µm], shape ``(L,)``; the ends are infinite."""
        return np.array([layer.thickness_um for layer in self.layers])

    @property
    def roughness_nm(self) -> FloatArray:
        """Rms roughness of the upper interface of layers 1…L-1 [nm], shape ``(L-1,)``."""
        return np.array([layer.roughness_nm for layer in self.layers[1:]])

    @property
    def thickness_spread_um(self) -> FloatArray:
        """Rms thickness spread of every layer inside a pixel [µm], shape ``(L,)``."""
        return np.array([layer.thickness_spread_um for layer in self.layers])

    def position(self, name: str) -> int:
        """Index of the layer called ``name``.

        Raises
        ------
        UnknownNameError
            There is no such layer.
        """
        if name not in self.names:
            raise UnknownNameError("layer", name, self.names, source=self.name)
        return self.names.index(name)

    @named_units
    def indices(self, wavelength_nm: ArrayLike, temperature_k: ArrayLike = 300.0) -> ComplexArray:
        """Complex index of every layer, shape ``(L, ...)`` with the broadcast shape of the arguments."""
        by_medium: dict[int, ComplexArray] = {}
        for layer in self.layers:
            if id(layer.medium) not in by_medium:
                by_medium[id(layer.medium)] = layer.medium.index(wavelength_nm, temperature_k)
        return np.stack([by_medium[id(layer.medium)] for layer in self.layers])

    def replace_layer(self, name: str, **changes: object) -> LayerStack:
        """Stack in which some attributes of one layer are changed."""
        position = self.position(name)
        layers = list(self.layers)
        layers[position] = replace(layers[position], **changes)  # type: ignore[arg-type]
        return replace(self, layers=tuple(layers))

    def with_medium(self, name: str, medium: Medium) -> LayerStack:
        """Stack in which the layer ``name`` is made of something else."""
        return self.replace_layer(name, medium=medium)

    def with_silicon(self, name: str, media: Mapping[str, Medium] | None = None) -> LayerStack:
        """Stack in which all silicon has the optical constants of another table.

        Parameters
        ----------
        name : `str`
            ``Si``, ``Si_green2008`` (the constants of the paper), ``Si_schinke2015`` or ``Si_franta2017``.
        media : mapping, optional
            Further media by name, as of `read_media`.

        Raises
        ------
        InputError
            It is not silicon.
        """
        medium = media[name] if media and name in media else get_medium(name)
        if not medium.is_silicon:
            raise InputError("table of silicon", name, "Si or one that begins with Si_", source=self.name)
        layers = tuple(
            replace(layer, medium=medium) if layer.medium.is_silicon else layer for layer in self.layers
        )
        return replace(self, layers=layers)

    def with_inserted(self, layer: Layer, *, before: str) -> LayerStack:
        """Stack with one more layer on the light's side of the layer called ``before``."""
        position = self.position(before)
        if position == 0:
            raise InputError("layer to insert before", before, "any layer but the ambient", source=self.name)
        return replace(self, layers=(*self.layers[:position], layer, *self.layers[position:]))
