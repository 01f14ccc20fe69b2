// The two protocols that `rhot feet` reads from a sensor on the ankle; docs/feet.md describes them.
//
// Plain C++11 without Arduino, so that a test compiles it on a computer and feeds its bytes to RHOT's decoders.
// Quaternions are i, j, k, real and rotate from the sensor's frame to a level one with z up.

#pragma once

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>

namespace rhot {

constexpr size_t kFrameBytes = 30;
constexpr size_t kLongestLine = 80;
constexpr uint8_t kPayloadBytes = 24;
constexpr float kForceStepsPerMps2 = 200.0f;  // ±163 m/s² in 16 bits
constexpr float kRateStepsPerRadps = 900.0f;  // ±36 rad/s in 16 bits
constexpr float kQuaternionSteps = 16384.0f;

inline bool allFinite(const float *values, size_t count) {
  for (size_t k = 0; k < count; ++k) {
    if (!isfinite(values[k])) return false;
  }
  return true;
}

// CRC-16, polynomial 1021, start value FFFF, not reflected.
inline uint16_t crc16(const uint8_t *bytes, size_t count) {
  uint16_t crc = 0xFFFF;
  for (size_t k = 0; k < count; ++k) {
    crc = static_cast<uint16_t>(crc ^ (static_cast<uint16_t>(bytes[k]) << 8));
    for (int bit = 0; bit < 8; ++bit) {
      crc = static_cast<uint16_t>((crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1);
    }
  }
  return crc;
}

inline size_t written(int count, size_t size) {
  return count > 0 && static_cast<size_t>(count) < size ? static_cast<size_t>(count) : 0;
}

// Writes one line of linear acceleration, m/s², gravity removed; returns its bytes, 0 if a value is not a number.
inline size_t encodeAcceleration(char *out, size_t size, uint32_t stamp_us, const float acceleration[3]) {
  if (!allFinite(acceleration, 3)) return 0;
  const int count = snprintf(out, size, "%lu L %.3f %.3f %.3f;\n", static_cast<unsigned long>(stamp_us),
                             static_cast<double>(acceleration[0]), static_cast<double>(acceleration[1]),
                             static_cast<double>(acceleration[2]));
  return written(count, size);
}

// Writes one line of orientation; returns its bytes, 0 if a value is not a number.
inline size_t encodeRotation(char *out, size_t size, uint32_t stamp_us, const float quaternion[4]) {
  if (!allFinite(quaternion, 4)) return 0;
  const int count = snprintf(out, size, "%lu R %.5f %.5f %.5f %.5f;\n", static_cast<unsigned long>(stamp_us),
                             static_cast<double>(quaternion[0]), static_cast<double>(quaternion[1]),
                             static_cast<double>(quaternion[2]), static_cast<double>(quaternion[3]));
  return written(count, size);
}

inline uint8_t *putSteps(uint8_t *out, const float *values, size_t count, float stepsPerUnit) {
  for (size_t k = 0; k < count; ++k) {
    float steps = roundf(values[k] * stepsPerUnit);
    steps = steps > 32767.0f ? 32767.0f : steps < -32768.0f ? -32768.0f : steps;
    const uint16_t bits = static_cast<uint16_t>(static_cast<int16_t>(steps));
    *out++ = static_cast<uint8_t>(bits & 0xFF);
    *out++ = static_cast<uint8_t>(bits >> 8);
  }
  return out;
}

// Writes one frame: specific force, m/s², gravity included; angular rate, rad/s; orientation, all 0 if there is none.
// What is beyond the scale is clipped. Returns its bytes, 0 if a value is not a number.
inline size_t encodeFrame(uint8_t out[kFrameBytes], uint8_t sequence, uint32_t stamp_us, const float force[3],
                          const float rate[3], const float quaternion[4]) {
  if (!allFinite(force, 3) || !allFinite(rate, 3) || !allFinite(quaternion, 4)) return 0;
  uint8_t *at = out;
  *at++ = 0xA5;
  *at++ = 0x5A;
  *at++ = kPayloadBytes;
  *at++ = sequence;
  for (int shift = 0; shift < 32; shift += 8) *at++ = static_cast<uint8_t>((stamp_us >> shift) & 0xFF);
  at = putSteps(at, force, 3, kForceStepsPerMps2);
  at = putSteps(at, rate, 3, kRateStepsPerRadps);
  at = putSteps(at, quaternion, 4, kQuaternionSteps);
  const uint16_t crc = crc16(out + 2, static_cast<size_t>(at - out) - 2);
  *at++ = static_cast<uint8_t>(crc & 0xFF);
  *at++ = static_cast<uint8_t>(crc >> 8);
  return static_cast<size_t>(at - out);
}

// Tells once when a button has been down for 50 ms, so that its bouncing counts as one press.
class Button {
 public:
  bool pressed(bool down, uint32_t now_ms) {
    if (!down) {
      since_ms_ = now_ms;
      told_ = false;
      return false;
    }
    if (told_ || now_ms - since_ms_ < kSteady_ms) return false;
    told_ = true;
    return true;
  }

 private:
  static constexpr uint32_t kSteady_ms = 50;
  uint32_t since_ms_ = 0;
  bool told_ = false;
};

}  // namespace rhot
