"""Sensors by name, and sensors at random.

A model is defined in the file of its name; here it gets the numbers of a product or of a protocol.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from simharness.sim.sensors.calibration import Calibration
from simharness.sim.sensors.gaussian import GammaScale, PatchNoise, SmoothDistortion
from simharness.sim.sensors.losses import Dropout, FlyingPixels
from simharness.sim.sensors.sensor import Sensor
from simharness.sim.sensors.stereo import Stereo
from simharness.sim.sensors.structured_light import Redwood, SimKinect
from simharness.sim.sensors.time_of_flight import TimeOfFlight

SensorName = Literal[
    "ideal",
    "gaussian",
    "dex",
    "patches",
    "d435",
    "d415",
    "d435-stereo",
    "d415-stereo",
    "tof",
    "dropout",
    "flying",
    "simkinect",
    "redwood",
    "d435-pose",
    "d435-uncalibrated",
]

D435 = Stereo(focal_length=424.0, baseline=0.050)
"""At 848 x 480, 90 degrees wide: nothing nearer than 0.17 m."""

D415 = Stereo(focal_length=1004.6, baseline=0.055)
"""At 1280 x 720, 65 degrees wide: nothing nearer than 0.44 m."""

_LOSSES = (FlyingPixels(), Dropout())
_GAUSSIAN = Sensor(point_sigma=0.0008)
_D435 = Sensor((D435, *_LOSSES))

SENSORS: Mapping[SensorName, Sensor] = {
    "ideal": Sensor(),
    "gaussian": _GAUSSIAN,
    "dex": Sensor((GammaScale(), PatchNoise())),
    "patches": Sensor((PatchNoise(),)),
    "d435": _D435,
    "d415": Sensor((D415, *_LOSSES)),
    "d435-stereo": Sensor((replace(D435, occlusion=False),)),
    "d415-stereo": Sensor((replace(D415, occlusion=False),)),
    "tof": Sensor((TimeOfFlight(), FlyingPixels())),
    "dropout": replace(_GAUSSIAN, depth=(Dropout(),)),
    "flying": replace(_GAUSSIAN, depth=(FlyingPixels(),)),
    "simkinect": Sensor((SimKinect(),)),
    "redwood": Sensor((Redwood(), SmoothDistortion())),
    "d435-pose": replace(_D435, calibration=Calibration(translation=0.005, rotation_deg=1.0, exact=True)),
    "d435-uncalibrated": replace(
        _D435, calibration=Calibration(translation=0.005, rotation_deg=1.0, depth_scale=0.02, table_height=0.005)
    ),
}
"""`gaussian` and `dex` are those of the two published protocols; `patches` is `dex` with its depth scale right;
`d435-stereo` and `d415-stereo` have the noise alone; `dropout` and `flying` are `gaussian` with one kind of loss;
`d435-pose` has a pose wrong by exactly 5 mm and 1 degree, and `d435-uncalibrated` is wrong by up to that, 2 % of depth
and 5 mm of table height."""


def random_sensor(rng: np.random.Generator) -> Sensor:
    """A sensor to train with: any strength of noise and of losses that an image shows, no shift that it cannot show.

    `simkinect` and `redwood` are kept for measuring.
    """
    kind = rng.choice(["gaussian", "patches", "d435", "d415", "tof"], p=[0.35, 0.1, 0.3, 0.15, 0.1])
    if kind == "gaussian":
        sensor = Sensor(point_sigma=float(rng.choice([rng.uniform(0.0, 0.001), rng.uniform(0.001, 0.004)])))
    elif kind == "patches":
        sensor = Sensor((PatchNoise(float(rng.uniform(0.001, 0.005))),))
    elif kind == "tof":
        sensor = Sensor((TimeOfFlight(),))
    else:
        stereo = D435 if kind == "d435" else D415
        sensor = Sensor((replace(stereo, sigma=float(rng.uniform(0.05, 0.2)), window=float(rng.uniform(5.0, 9.0))),))
    if rng.uniform() < 0.5:
        sensor = sensor.with_part(FlyingPixels(share=float(rng.uniform(0.1, 0.7))))
    if rng.uniform() < 0.5:
        sensor = sensor.with_part(Dropout(mean_number=float(rng.uniform(5.0, 40.0))))
    return sensor
