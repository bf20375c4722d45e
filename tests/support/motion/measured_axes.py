"""Recordings of real axes, which lie beside the checkout, and what is published about them."""

import numpy as np

from motorhil.harness.identification.samples import Samples

PUBLISHED = {"inertia": 95.1089, "viscous": 203.5034, "coulomb": 20.3935, "offset": -3.1648}
"""Janot, Gautier and Brunot, "Data Set and Reference Models of EMPS", 2019."""


def emps(shared, name):
    """Return the samples of a record of EMPS (needs scipy)."""
    from scipy.io import loadmat

    data = {
        key: np.asarray(value).ravel()
        for key, value in loadmat(shared / "data" / "emps" / name).items()
        if not key.startswith("__")
    }
    force = data["gtau"] * data["vir"]
    return Samples("emps", "m", float(data["t"][1] - data["t"][0]), data["qm"], force, name)


def ak80(shared):
    """Return the samples of a T-Motor AK80's chirp of current, on even times."""
    file = shared / "data" / "traffic" / "tmotor_ak80_current_chirp.csv"
    told = np.genfromtxt(file, delimiter=",", names=True)
    times = told["pi_time"]
    even = np.arange(times[0], times[-1], 1e-3)
    position, torque = (np.interp(even, times, told[name]) for name in ("angle", "torque"))
    return Samples("ak80", "rad", 1e-3, position, torque, file.name)
