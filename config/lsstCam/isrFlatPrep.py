# Flats of the LSST Camera's sensors: those with black coating were taken with the narrow line.
from lsst.fringe_sim.instrument.camera import Camera

config.setup = "ts8_e2v"
for detector in Camera.from_name("lsstCam").science:
    if detector.vendor == "ITL":
        config.raft_setups[detector.raft] = "ts8_itl"
