# Raft module RTM-020, the raft of Guo, Walter, Lage & Lupton 2022; today R11 of the LSST Camera. One run of its own:
#   pipetask run ... -C isrFlatPrep:config/ts8/rafts/RTM-020.py -C epoxyFit:config/ts8/rafts/RTM-020.py \
#       -d "detector.raft = 'RTM-020'"
# What the camera says comes first, what this raft has of its own afterwards.
import os

config.load(os.path.join(os.path.dirname(__file__), os.pardir, f"{config.task_name}.py"))

if config.task_name == "isrFlatPrep":
    # Section 3.1: flats from 880 to 990 nm.
    config.min_wavelength_nm = 875.0
    config.max_wavelength_nm = 995.0
if config.task_name == "epoxyFit":
    # Twelve wavelengths were taken; with fewer than eight the order of the thick sensors is in doubt.
    config.min_wavelengths = 8
