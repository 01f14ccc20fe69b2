// A sensor for the ankle: ESP32 and BNO080, BNO085 or BNO086 over SPI, for `rhot feet`; docs/feet.md says how to build it.
//
// Arduino IDE: board package "esp32" by Espressif, library "SparkFun BNO08x Cortex Based IMU", newer than
// 1.0.2 (with `setCalibrationConfig`).
// This sketch is compiled and played through on a computer by tests/feet/sources/test_firmware.py; it has not run on a
// board of ours.

#include <SPI.h>
#include <SparkFun_BNO08x_Arduino_Library.h>

#include "protocol.h"

// ---- What you may change ------------------------------------------------------------------------------------------
#define RHOT_BINARY 0     // 0: text at 100 Hz (format = "text"), 1: frames at 400 Hz (format = "binary")
#define RHOT_BLUETOOTH 0  // 0: USB; 1: Bluetooth's serial port, classic ESP32 only, text only
constexpr char kName[] = "RHOT ankle left";  // as Bluetooth shows it

constexpr uint8_t kPinSelect = 5;   // CS
constexpr uint8_t kPinReady = 17;   // INT
constexpr uint8_t kPinReset = 16;   // RST
constexpr uint8_t kPinButton = 0;   // BOOT on most boards; any pin with a button to GND
constexpr uint8_t kPinLight = 2;    // built-in LED on most boards
// -------------------------------------------------------------------------------------------------------------------

#if RHOT_BINARY && RHOT_BLUETOOTH
#error "Bluetooth's serial port delays 400 frames a second by too much; use USB, or RHOT_BINARY 0"
#endif
#if RHOT_BLUETOOTH
#include <BluetoothSerial.h>
BluetoothSerial toPc;
#else
#define toPc Serial
#endif

constexpr uint32_t kBaud = RHOT_BINARY ? 460800 : 115200;
constexpr uint32_t kInterval_us = RHOT_BINARY ? 2500 : 10000;

BNO08x sensor;
rhot::Button button;
bool calibrating = false;
volatile uint32_t ready_us = 0;  // when the sensor last had something to say: the time of the sample that follows

#if RHOT_BINARY
uint8_t sequence = 0;
float force[3], quaternion[4];
bool haveForce = false;
#endif

void IRAM_ATTR onReady() { ready_us = micros(); }

void enableReports() {
  // Without the magnetometer: steel in floors and furniture turns its north, and RHOT finds a sensor's north by itself.
  sensor.enableReport(SH2_GAME_ROTATION_VECTOR, kInterval_us);
#if RHOT_BINARY
  sensor.enableReport(SH2_ACCELEROMETER, kInterval_us);
  sensor.enableReport(SH2_GYROSCOPE_CALIBRATED, kInterval_us);
#else
  sensor.enableReport(SH2_LINEAR_ACCELERATION, kInterval_us);
#endif
}

// The gyroscope's zero is followed at all times, whenever the foot stands; the accelerometer's only while calibrating.
void setCalibrating(bool on) {
  calibrating = on;
  sensor.setCalibrationConfig(on ? SH2_CAL_ACCEL | SH2_CAL_GYRO : SH2_CAL_GYRO);
}

void setup() {
  pinMode(kPinButton, INPUT_PULLUP);
  pinMode(kPinLight, OUTPUT);
#if RHOT_BLUETOOTH
  toPc.begin(kName);
#else
  toPc.begin(kBaud);
#endif
  SPI.begin();
  // No text to the line on errors: RHOT says that a sensor is silent, and a fast blink says why.
  while (!sensor.beginSPI(kPinSelect, kPinReady, kPinReset)) {
    digitalWrite(kPinLight, (millis() / 100) % 2 == 0 ? HIGH : LOW);
    delay(100);
  }
  attachInterrupt(digitalPinToInterrupt(kPinReady), onReady, FALLING);
  setCalibrating(false);
  enableReports();
}

// First press: calibrate, the light blinks. Second press: keep it in the sensor's own memory.
void handleButton() {
  const uint32_t now_ms = millis();
  if (button.pressed(digitalRead(kPinButton) == LOW, now_ms)) {
    if (calibrating) sensor.saveCalibration();
    setCalibrating(!calibrating);
  }
  digitalWrite(kPinLight, !calibrating || (now_ms / 250) % 2 == 0 ? HIGH : LOW);
}

void send(const sh2_SensorValue_t &value, uint32_t stamp_us) {
#if RHOT_BINARY
  switch (value.sensorId) {
    case SH2_ACCELEROMETER:
      force[0] = value.un.accelerometer.x;
      force[1] = value.un.accelerometer.y;
      force[2] = value.un.accelerometer.z;
      haveForce = true;
      break;
    case SH2_GAME_ROTATION_VECTOR:
      quaternion[0] = value.un.gameRotationVector.i;
      quaternion[1] = value.un.gameRotationVector.j;
      quaternion[2] = value.un.gameRotationVector.k;
      quaternion[3] = value.un.gameRotationVector.real;
      break;
    case SH2_GYROSCOPE_CALIBRATED: {
      const float rate[3] = {value.un.gyroscope.x, value.un.gyroscope.y, value.un.gyroscope.z};
      uint8_t frame[rhot::kFrameBytes];
      const size_t count =
          haveForce ? rhot::encodeFrame(frame, sequence, stamp_us, force, rate, quaternion) : 0;
      if (count > 0) {
        ++sequence;
        toPc.write(frame, count);
      }
      break;
    }
  }
#else
  char line[rhot::kLongestLine];
  size_t count = 0;
  if (value.sensorId == SH2_LINEAR_ACCELERATION) {
    const float a[3] = {value.un.linearAcceleration.x, value.un.linearAcceleration.y, value.un.linearAcceleration.z};
    count = rhot::encodeAcceleration(line, sizeof line, stamp_us, a);
  } else if (value.sensorId == SH2_GAME_ROTATION_VECTOR) {
    const float q[4] = {value.un.gameRotationVector.i, value.un.gameRotationVector.j, value.un.gameRotationVector.k,
                        value.un.gameRotationVector.real};
    count = rhot::encodeRotation(line, sizeof line, stamp_us, q);
  }
  if (count > 0) toPc.write(reinterpret_cast<const uint8_t *>(line), count);
#endif
}

void loop() {
  if (sensor.wasReset()) enableReports();
  const uint32_t stamp_us = ready_us;
  if (sensor.getSensorEvent()) send(sensor.sensorValue, stamp_us);
  handleButton();
}
