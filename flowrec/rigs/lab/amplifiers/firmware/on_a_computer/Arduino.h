// What flowrec_coils.ino needs of Arduino, on a computer: see arduino.cpp.
#pragma once
#include <stddef.h>
#include <stdint.h>

enum { LOW, HIGH, OUTPUT };
uint32_t millis();
uint32_t micros();
void pinMode(int pin, int mode);
void digitalWrite(int pin, int level);
void analogWrite(int pin, int value);
int analogRead(int pin);

struct SerialPort {
  void begin(long baud);
  int available();
  int read();
  int availableForWrite();
  size_t write(const uint8_t *bytes, size_t count);
};
extern SerialPort Serial;
void setup();
void loop();
