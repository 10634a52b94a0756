"""The search for missing effects put to the test: sealed cases, an oracle, and what came of them.

This room knows both sides, the independent simulator of `lsst.fringe_sim.mock` and the search of
`lsst.fringe_sim.algorithms.discovery`, which do not know each other. Only the command line imports it.
"""
