// What the sketch uses of the sensor's library, on a computer; names as in SparkFun's library and CEVA's sh2.
#pragma once
#include "Arduino.h"

typedef uint8_t sh2_SensorId_t;
enum {
  SH2_ACCELEROMETER = 0x01,
  SH2_GYROSCOPE_CALIBRATED = 0x02,
  SH2_LINEAR_ACCELERATION = 0x04,
  SH2_GAME_ROTATION_VECTOR = 0x08
};
enum { SH2_CAL_ACCEL = 1, SH2_CAL_GYRO = 2 };
struct Xyz {
  float x, y, z;
};
struct Rotation {
  float i, j, k, real;
};
struct sh2_SensorValue_t {
  uint8_t sensorId;
  struct {
    Xyz accelerometer, linearAcceleration, gyroscope;
    Rotation gameRotationVector;
  } un;
};

class BNO08x {
 public:
  sh2_SensorValue_t sensorValue;
  bool beginSPI(uint8_t, uint8_t, uint8_t) { return true; }
  bool wasReset() { return false; }
  bool enableReport(sh2_SensorId_t sensor, uint32_t interval_us = 10000, uint32_t = 0);
  bool getSensorEvent();
  bool setCalibrationConfig(uint8_t sensors);
  bool saveCalibration();
};
