// Encodes what standard input asks for, one record a line, with the firmware's encoder:
//   L stamp x y z | R stamp i j k real | F sequence stamp fx fy fz rx ry rz i j k real
#include "protocol.h"

int main() {
  char kind;
  while (scanf(" %c", &kind) == 1) {
    unsigned sequence = 0;
    unsigned long stamp = 0;
    float v[10];
    const int count = kind == 'L' ? 3 : kind == 'R' ? 4 : 10;
    if (kind == 'F' && scanf("%u", &sequence) != 1) return 1;
    if (scanf("%lu", &stamp) != 1) return 1;
    for (int k = 0; k < count; ++k) {
      if (scanf("%f", &v[k]) != 1) return 1;
    }
    char line[rhot::kLongestLine];
    uint8_t frame[rhot::kFrameBytes];
    const uint32_t t = static_cast<uint32_t>(stamp);
    if (kind == 'L') fwrite(line, 1, rhot::encodeAcceleration(line, sizeof line, t, v), stdout);
    if (kind == 'R') fwrite(line, 1, rhot::encodeRotation(line, sizeof line, t, v), stdout);
    if (kind == 'F') fwrite(frame, 1, rhot::encodeFrame(frame, static_cast<uint8_t>(sequence), t, v, v + 3, v + 6), stdout);
  }
  return 0;
}
