"""What rules leave out, as recorded: errors of coarse sums, numbers of nodes, bounds; no exact result shows it."""

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.optics import Beam, LayerStack, PhaseResponse
from lsst.fringe_sim.optics.coherence import phase_states
from lsst.fringe_sim.optics.diffuse import DiffuseReturn
from lsst.fringe_sim.optics.harmonics import series_on_grid
from lsst.fringe_sim.optics.illumination import GaussianProfile, TriangularProfile


def response(ratio: float, loss: float, spread_um: float = 0.0) -> tuple[PhaseResponse, np.ndarray]:
    """Coefficients without a stack behind them: two exposures, seven nodes."""
    rng, shape = np.random.default_rng(17), (2, 2, 7)
    a, b, e = rng.normal(size=(3, *shape))
    c = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    g = ratio * rng.uniform(0.3, 1.0, shape) * np.exp(2j * np.pi * rng.random(shape))
    kappa = rng.uniform(15.0, 25.0, shape) + 1j * loss * rng.uniform(0.1, 1.0, shape)
    return PhaseResponse(a, b, e, c, g, kappa, spread_um=spread_um), rng.uniform(0.1, 1.0, (2, 7))


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-7])
@pytest.mark.parametrize(("ratio", "loss", "spread_um"), [(0.4, 0.0, 0.0), (0.8, 0.0, 0.01), (0.5, 0.3, 0.0)])
def test_errors_of_coarse_series_are_as_recorded(
    ratio: float, loss: float, spread_um: float, tolerance: float, recorded: Record
) -> None:
    made, weight = response(ratio, loss, spread_um)
    thickness = 12.0 + 0.004 * np.arange(700)
    arrays, weights, _ = made._grouped(weight)
    coarse = series_on_grid(arrays, weights, spread_um, 12.0, 0.004, 700, tolerance=tolerance)
    error = coarse - made.averaged(weight, thickness)
    size = np.ptp(made.averaged(weight, thickness))
    assert np.abs(error).max() < 3.0 * tolerance * size
    recorded({"error": error / (tolerance * size)})


def test_bounds_of_derivatives_are_as_recorded(recorded: Record) -> None:
    made = {f"{ratio} {loss}": response(ratio, loss) for ratio, loss in ((0.4, 0.0), (0.8, 0.2))}
    recorded({
        f"{name} {order} {start}": one.derivative_bound(weight, order, start)
        for name, (one, weight) in made.items() for order in (1, 2, 4) for start in (0.0, 10.0)
    })  # fmt: skip


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_phases_of_incoherent_layers_are_as_recorded(polarization: str, recorded: Record) -> None:
    wavelength = np.array([0.9, 0.95, 1.0])
    index = np.array([1.0, 1.4 + 0.001j, 3.6 + 0.0005j, 1.6, 3.9 + 0.01j])[:, None] * np.ones(3)
    thickness, theta = np.array([0.0, 0.12, 100.0, 14.0, 0.0]), np.full(3, 0.2)
    found = {}
    for name, shifted, spread in (
        ("none", [], 0.0), ("whole", [3], np.inf), ("little", [3], 0.004), ("much", [3], 0.3), ("two", [2, 3], 0.05),
    ):  # fmt: skip
        states = phase_states(
            index, thickness, wavelength, theta, polarization, shifted, np.full(thickness.shape, spread)
        )
        shares = np.array([np.broadcast_to(state.share, 3) for state in states])
        assert np.allclose(shares.sum(axis=0), 1.0)
        phases = [[float(np.mean(phase)) for phase in state.phases.values()] for state in states]
        found[name] = {"shares": shares, "phases": np.array(phases)}
    recorded(found)


def test_nodes_are_as_recorded(recorded: Record) -> None:
    lines = {
        f"{kind.__name__} {width} {step}": [np.asarray(part) for part in kind(width).nodes(step)]
        for kind in (GaussianProfile, TriangularProfile)
        for width in (0.3, 2.0, 7.0)
        for step in (0.1, 0.5)
    }
    beams = {
        f"{f_number} {inner} {nodes}": Beam.cone(f_number, inner, nodes)
        for f_number, inner, nodes in ((1.2, 0.6, 16), (4.0, 0.0, 64))
    }
    stack = LayerStack.from_resource("e2v_ccd250")
    names = [layer.name for layer in stack.layers]
    below = names.index("detection") + 1 if "detection" in names else 3
    diffuse = DiffuseReturn(names[below], names[below + 1], 0.3, 0.4)
    fate = diffuse.fate(stack, names[below - 1], np.array([880.0, 881.3, 950.0, 1010.0]), 183.0)
    angles = {name: beam.mean_angle for name, beam in beams.items()}
    recorded({
        "lines": lines, "beams": beams, "angles": angles, "fate": list(fate),
        "attenuation": diffuse.attenuation(stack), "returned": list(diffuse.returned()),
    })  # fmt: skip
