"""How well the model is known: a disagreement that its tables may be wrong by is none that an effect must explain."""

from __future__ import annotations

MODEL_ACCURACY = 0.014
"""Error of the fringes of the model at a wavelength, as a part of their amplitude and in radians of their phase.

It is that of the absorption of silicon at 1 µm. No other table of optical constants states an uncertainty there.
"""

ACCURACY_SOURCE = "absorption of silicon at 1 um, Schinke et al. 2015, doi 10.1063/1.4923419"

TABLE_STEP_NM = 10.0
"""Wavelength over which the errors of a table are alike [nm]: the step at which constants of silicon are stated
(Green 2008, doi 10.1016/j.solmat.2008.06.009); between its entries a table is as wrong as its neighbours are."""
