// What the sketch uses of a board, on a computer: its line is standard output, its time is counted by `board.cpp`.
#pragma once
#include <math.h>
#include <stdint.h>
#include <stdio.h>

#define IRAM_ATTR
enum { LOW = 0, HIGH = 1, OUTPUT = 1, INPUT_PULLUP = 2, FALLING = 2 };

extern uint32_t board_us;
extern bool board_button;
extern void (*board_ready)();

inline uint32_t micros() { return board_us; }
inline uint32_t millis() { return board_us / 1000; }
inline void delay(uint32_t) {}
inline void pinMode(uint8_t, int) {}
inline void digitalWrite(uint8_t, int) {}
inline int digitalRead(uint8_t) { return board_button ? LOW : HIGH; }
inline int digitalPinToInterrupt(uint8_t pin) { return pin; }
inline void attachInterrupt(int, void (*handler)(), int) { board_ready = handler; }

struct Line {
  void begin(uint32_t) {}
  void write(const uint8_t *bytes, size_t count) { fwrite(bytes, 1, count, stdout); }
};
extern Line Serial;
