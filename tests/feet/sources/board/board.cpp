// Plays the sketch on a computer: two seconds of a sensor whose values follow from the time, and four button presses.
// Standard output is the line to the PC; standard error counts how often the calibration was kept.
#include "Arduino.h"
#include "SPI.h"
#include "SparkFun_BNO08x_Arduino_Library.h"

void setup();
void loop();

uint32_t board_us = 4294000000u;  // wraps around on the way
bool board_button = false;
void (*board_ready)() = nullptr;
Line Serial;
Spi SPI;

static uint32_t interval_us[256];
static uint32_t next_us[256];
static int saved = 0;
static uint8_t calibrated = 0;  // what is being calibrated

bool BNO08x::enableReport(sh2_SensorId_t sensor, uint32_t interval, uint32_t) {
  interval_us[sensor] = interval;
  next_us[sensor] = board_us + interval;
  return true;
}

bool BNO08x::setCalibrationConfig(uint8_t sensors) {
  calibrated = sensors;
  return true;
}

bool BNO08x::saveCalibration() {
  // What was not calibrated is not worth keeping.
  saved += calibrated == (SH2_CAL_ACCEL | SH2_CAL_GYRO);
  return true;
}

bool BNO08x::getSensorEvent() {
  for (int sensor = 0; sensor < 256; ++sensor) {
    if (interval_us[sensor] == 0 || static_cast<int32_t>(board_us - next_us[sensor]) < 0) continue;
    next_us[sensor] += interval_us[sensor];
    const float t = 1e-6f * static_cast<float>(board_us - 4294000000u);
    sensorValue.sensorId = static_cast<uint8_t>(sensor);
    sensorValue.un.accelerometer = {t, -2.0f, 9.81f};
    sensorValue.un.linearAcceleration = {t, -2.0f, 0.0f};
    sensorValue.un.gyroscope = {0.5f, -0.25f, t};
    sensorValue.un.gameRotationVector = {0.0f, 0.0f, sinf(0.5f * t), cosf(0.5f * t)};
    return true;
  }
  return false;
}

int main() {
  setup();
  for (int tick = 0; tick < 20000; ++tick) {
    board_us += 100;
    // Pressed at 0.2, 0.6, 1.0 and 1.4 s for 0.1 s; it bounces at first.
    const int phase = tick % 4000;
    board_button = tick < 16000 && phase >= 2000 && phase < 3000 && (phase > 2050 || phase % 2);
    if (board_ready) board_ready();
    for (int event = 0; event < 4; ++event) loop();
  }
  fprintf(stderr, "%d", saved);
  return 0;
}
