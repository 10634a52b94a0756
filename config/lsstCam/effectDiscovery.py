# Flats are searched with the set-ups in which they are fitted.
import os

config.load(os.path.join(os.path.dirname(__file__), "epoxyFit.py"))
