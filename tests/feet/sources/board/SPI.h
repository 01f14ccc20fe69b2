#pragma once
#include "Arduino.h"
struct Spi {
  void begin() {}
};
extern Spi SPI;
