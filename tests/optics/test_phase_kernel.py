"""The compiled reduction against the numpy one, which also takes dual numbers."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lsst.fringe_sim.optics.phase_kernel import reduce_nodes
from lsst.fringe_sim.optics.phase_response import reduce_polarization


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(3, 9),
    nodes=st.integers(1, 150),
    polarization=st.sampled_from(["s", "p"]),
    rough=st.booleans(),
    normal_incidence=st.booleans(),
    data=st.data(),
)
def test_compiled_is_numpy(
    seed: int,
    count: int,
    nodes: int,
    polarization: str,
    rough: bool,
    normal_incidence: bool,
    data: st.DataObject,
) -> None:
    """Rough interfaces, extra phases, metals and transparent layers, total reflection."""
    rng = np.random.default_rng(seed)
    varying = data.draw(st.integers(1, count - 2))
    layers = sorted(data.draw(st.sets(st.integers(1, count - 2), min_size=1)))
    loss = rng.uniform(0.0, 3.0, count) * (rng.random(count) < 0.4)
    index = np.repeat((rng.uniform(1.0, 4.0, count) + 1j * loss)[:, None], nodes, axis=1)
    index[0] = 1.5
    thickness = rng.uniform(0.0, 2.0, count)
    wavelength = rng.uniform(0.4, 1.1, nodes)
    theta = np.zeros(nodes) if normal_incidence else rng.uniform(0.0, 1.5, nodes)
    heights = rng.uniform(0.0, 0.05, count - 1) if rough else np.zeros(count - 1)
    inner = [layer for layer in range(1, count - 1) if layer != varying]
    phases = {layer: float(rng.uniform(0.0, 6.0)) for layer in inner[: data.draw(st.integers(0, 2))]}

    def by_numpy(scale: float) -> tuple[np.ndarray, ...]:
        return reduce_polarization(
            index, scale * thickness, wavelength, theta, polarization, varying, layers,
            heights if rough else None, phases,
        )  # fmt: skip

    expected = by_numpy(1.0)
    # Where light is totally reflected, large fluxes cancel: what rounding of the input does, rounding inside may do.
    rounded = [by_numpy(1.0 + step * np.finfo(float).eps) for step in (-4, -2, 2, 4)]
    phase = np.zeros(count)
    phase[list(phases)] = list(phases.values())
    found = reduce_nodes(
        index, thickness, wavelength, theta, polarization == "p", varying, np.array(layers), heights, phase
    )
    for place, (one, other) in enumerate(zip(found, expected, strict=True)):
        shaken = max(np.abs(trial[place] - other).max() for trial in rounded)
        scale = max(1.0, np.abs(other).max())
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * scale + 30.0 * shaken)
