# What is fitted depends on the vendor of the raft: the adhesive of e2v sensors, the silicon of ITL sensors.
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.tasks import RaftConfig

config.setup = "ts8_e2v"
for detector in Camera.from_name("ts8").science:
    if detector.vendor == "ITL":
        config.rafts[detector.raft] = RaftConfig(setup="ts8_itl")
