/* fieldcal on board: configuration. Defaults; `fieldcal onboard DIR` writes those of a vehicle. */
#ifndef FIELDCAL_ONBOARD_CONFIG_H
#define FIELDCAL_ONBOARD_CONFIG_H

#define FIELDCAL_FULL_MATRIX 0 /* 1: room for symmetric scale matrices */

#define FIELDCAL_FIELD_NORM 1.0f /* length of the local field, in the unit wanted for the magnetometer */
#define FIELDCAL_FIELD_NED {1.0f, 0.0f, 0.0f} /* its direction */
#define FIELDCAL_GRAVITY 9.80665f
#define FIELDCAL_GRAVITY_SIGN 1.0f /* 1: the accelerometer reads +g on the down axis at rest; -1: -g */
#define FIELDCAL_MAGNETOMETER_POLARITY {1.0f, 1.0f, 1.0f}
#define FIELDCAL_ACCELEROMETER_POLARITY {1.0f, 1.0f, 1.0f}
#define FIELDCAL_GYROSCOPE_POLARITY {1.0f, 1.0f, 1.0f}
#define FIELDCAL_DIRECTION_SD {0.01f, 0.01f} /* rad, of the sensed field and gravity: weights of the attitude */

#define FIELDCAL_MAX_CONDITION 50.0f
#define FIELDCAL_MAX_SCALE_SD 0.05f
#define FIELDCAL_MAX_RESIDUAL 0.1f
#define FIELDCAL_GYROSCOPE_MAX_SCALE_SD 0.05f
#define FIELDCAL_MAGNETOMETER_CORRELATED 30.0f /* samples over which a disturbance stays alike: 0.3 s */
#define FIELDCAL_ACCELEROMETER_CORRELATED 30.0f
#define FIELDCAL_MAGNETOMETER_IN_MEAN 2u /* readings averaged to tell noise: 20 ms */
#define FIELDCAL_ACCELEROMETER_IN_MEAN 2u
#define FIELDCAL_BLOCK_SAMPLES 10 /* attitudes a derivative: 0.1 s */
#define FIELDCAL_FORGETTING 1.0f  /* factor a block; 1: nothing is forgotten */
#define FIELDCAL_MAX_GAP_US 50000u

#endif
