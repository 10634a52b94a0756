# The y band through the LSST optics; the stack depends on the vendor of the raft.
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.tasks import RaftConfig

config.setup = "lsst_e2v"
for detector in Camera.from_name("lsstCam").science:
    if detector.vendor == "ITL":
        config.rafts[detector.raft] = RaftConfig(setup="lsst_itl")
