# Flats of SLAC Test Stand 8: sensors with black coating were taken with the narrow line.
from lsst.fringe_sim.instrument.camera import Camera

config.setup = "ts8_e2v"
for detector in Camera.from_name("ts8").science:
    if detector.vendor == "ITL":
        config.raft_setups[detector.raft] = "ts8_itl"
