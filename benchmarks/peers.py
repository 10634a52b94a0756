"""R and T of random stacks from vectorised peers: who is right, and how fast. Peers that are absent are named.

tmm-fast needs PyTorch and tmmax needs JAX; both are heavy, so that neither is needed by anything else here. tmmax
computes in single precision (it fails when JAX is switched to double).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import numpy as np
import tmm

from lsst.fringe_sim.optics import layer_absorption

from ._table import Row, median_time

STACKS = 100
WAVELENGTHS_UM = np.linspace(0.85, 1.05, 50)
THETA = 0.3


def run() -> list[Row]:
    rows = []
    for layers in (1, 2, 8):
        rng = np.random.default_rng(layers)
        n = rng.uniform(1.3, 3.8, layers + 2) + 1j * rng.uniform(0.0, 0.01, layers + 2)
        n[[0, -1]] = 1.0, 1.5
        d = np.full((STACKS, layers + 2), np.inf)
        d[:, 1:-1] = rng.uniform(0.05, 2.0, (STACKS, layers))
        rows.extend(compare(n, d))
    return rows


def compare(n: np.ndarray, d: np.ndarray) -> list[Row]:
    layers = len(n) - 2
    work = f"R and T of {STACKS} stacks of {layers} layers × {WAVELENGTHS_UM.size} wavelengths, p, 0.3 rad"
    evaluations = float(STACKS * WAVELENGTHS_UM.size)
    exact = by_tmm(n, d[:2])
    tmm_s = median_time(lambda: by_tmm(n, d[:2]), 1) * STACKS / 2
    rows = [Row(work, "tmm 0.2 (2 stacks)", tmm_s, evaluations)]
    ways: list[tuple[str, str, Callable[[], np.ndarray]]] = [
        ("layer_absorption (this package)", "numpy", lambda: ours(n, d)),
        ("tmm-fast", "tmm_fast", lambda: by_tmm_fast(n, d)),
        ("tmmax", "tmmax", by_tmmax(n, d) if importlib.util.find_spec("tmmax") else lambda: d),
    ]
    for name, module, way in ways:
        if importlib.util.find_spec(module) is None:
            rows.append(Row(work, name, float("nan"), evaluations, None, "not installed"))
            continue
        error = np.abs(way()[:, :2] - exact).max()
        rows.append(
            Row(work, name, median_time(way, 5), evaluations, tmm_s / evaluations, f"from tmm {error:.0e}")
        )
    return rows


def by_tmm(n: np.ndarray, d: np.ndarray) -> np.ndarray:
    cases = [[tmm.coh_tmm("p", n, each, THETA, wave) for wave in WAVELENGTHS_UM] for each in d]
    return np.array([[[case[name] for case in row] for row in cases] for name in ("R", "T")])


def ours(n: np.ndarray, d: np.ndarray) -> np.ndarray:
    thickness = d.T[:, :, None]
    return layer_absorption(n[:, None, None], thickness, WAVELENGTHS_UM, THETA, "p")[[0, -1]]


def by_tmm_fast(n: np.ndarray, d: np.ndarray) -> np.ndarray:
    from tmm_fast import coh_tmm

    index = np.broadcast_to(n[None, :, None], (len(d), n.size, WAVELENGTHS_UM.size)).copy()
    result = coh_tmm("p", index, d * 1e-6, np.array([THETA]), WAVELENGTHS_UM * 1e-6)
    return np.array([np.asarray(result[name])[:, 0] for name in ("R", "T")])


def by_tmmax(n: np.ndarray, d: np.ndarray) -> Callable[[], np.ndarray]:
    import jax
    import jax.numpy as jnp
    from tmmax.tmm import tmm_coh_single_wl_angle_point

    ends = np.array([WAVELENGTHS_UM[0] - 0.1, WAVELENGTHS_UM[-1] + 0.1])
    data = jnp.array([[ends, np.full(2, each.real), np.full(2, each.imag)] for each in n])
    order = jnp.arange(len(n))
    inner = jnp.array(d[:, 1:-1])

    def point(thickness: jax.Array, wave: jax.Array) -> tuple[jax.Array, jax.Array]:
        polarization = jnp.array([True])
        return tmm_coh_single_wl_angle_point(data, order, thickness, wave, jnp.array(THETA), polarization)

    function = jax.jit(jax.vmap(jax.vmap(point, (None, 0)), (0, None)))

    def way() -> np.ndarray:
        reflected, through = function(inner, jnp.array(WAVELENGTHS_UM))
        return np.array([np.asarray(reflected), np.asarray(through)]).reshape(2, len(d), -1)

    return way
