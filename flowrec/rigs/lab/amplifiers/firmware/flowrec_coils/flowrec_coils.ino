// SPDX-License-Identifier: Apache-2.0
//
// flowrec_coils: coils on a microcontroller that generates the rotating field itself.
//
// The recorder sends what the field does (frequency, heading, amplitude), not currents: the phase is kept here, so it is
// continuous whatever the recorder and the cable do, and the turns of the field are counted where they are made.
// Without a valid line for TIMER_MS the output goes to zero. The protocol is described in README.md beside this file.
//
// For a 32-bit board with a floating point unit, or at least 48 MHz (Teensy, RP2040, RP2350, ESP32, SAMD21, STM32).
// To adapt it to a board, change the section "Board"; leave the rest as it is.

#include <Arduino.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

// ---- Board

#ifndef TIMER_MS
#define TIMER_MS 100  // time without a valid line until the output goes to zero; 0 switches this off: for tests only
#endif
#ifndef MAX_UA
#define MAX_UA 5000000L  // largest current of a coil that this amplifier makes, in microamperes
#endif
#define MODEL "flowrec-coils"
#define BAUD 115200      // boards with USB of their own ignore it
#define UPDATE_US 200UL  // time from one output sample to the next
#ifndef PWM_FULL
#define PWM_FULL 255     // analogWrite of the full scale
#endif

// One H-bridge for each coil, controlled by a PWM and a direction pin. The full scale makes MAX_UA. Of three coils the
// order is x, y, z, else that of the columns of coils.mt_per_a. There are as many coils as pins; up to 12.
#ifndef PWM_PINS
#define PWM_PINS 2, 3, 4
#define DIR_PINS 5, 6, 7
#endif
static const int PWM_PIN[] = {PWM_PINS};
static const int DIR_PIN[] = {DIR_PINS};
static const int COILS = sizeof PWM_PIN / sizeof PWM_PIN[0];
static_assert(sizeof DIR_PIN == sizeof PWM_PIN, "each coil needs a PWM pin and a direction pin");
static_assert(COILS >= 3 && COILS <= 12, "a rotating field needs three coils; a line has room for twelve");

// Sensors of the currents, where the board has them: a pin for each coil, the count of analogRead without a current, and
// microamperes a count. Without SENSE_PINS nothing is measured.
// #define SENSE_PINS A0, A1, A2
#ifdef SENSE_PINS
#ifndef SENSE_ZERO
#define SENSE_ZERO 2048
#define SENSE_UA 2500L
#endif
static const int SENSE_PIN[] = {SENSE_PINS};
static const int SENSORS = COILS;
static_assert(sizeof SENSE_PIN == sizeof PWM_PIN, "each coil needs a sensor, or none has one");
static int32_t measured_ua(int c) { return (int32_t)(analogRead(SENSE_PIN[c]) - SENSE_ZERO) * SENSE_UA; }
#else
static const int SENSORS = 0;
static int32_t measured_ua(int) { return 0; }
#endif

static void begin_outputs() {
  for (int c = 0; c < COILS; c++) {
    pinMode(PWM_PIN[c], OUTPUT);
    pinMode(DIR_PIN[c], OUTPUT);
    analogWrite(PWM_PIN[c], 0);
  }
}

static void write_coil(int c, float microamperes) {
  digitalWrite(DIR_PIN[c], microamperes < 0.0f ? HIGH : LOW);
  analogWrite(PWM_PIN[c], (int)(fabsf(microamperes) * (PWM_FULL / (float)MAX_UA) + 0.5f));
}

// ---- State. Angles of the field are 32-bit fractions of a turn, so they wrap without an error.

static const float TURN = 4294967296.0f;  // 2^32
static const int32_t QUARTER = 1073741824L;
static const uint32_t HALF = 2147483648UL;

static bool armed = false;
static char why_off = 'B';    // B: after the start, Z: by a Z line, T: by the timer
static uint32_t heard_ms = 0;  // when the last valid line came
static int32_t last_seq = -1;

static float vector_ua[4][COILS];       // per mT: vertical, horizontal along 0 and 90 degrees; and the bias, uA
static float limit_ua = 0.0f;       // of each coil
static float fade_ut = 0.0f;        // below this amplitude the compensation of the bias is reduced in proportion
static uint8_t configured = 0;      // bits 0 to 3: vectors, 4: limits
static const uint8_t COMPLETE = 0x1f;

static uint32_t phase = 0, plane = 0, heading = 0;
static float amplitude_ut = 0.0f, target_ut = 0.0f, ramp_ut_s = 0.0f;
static float frequency_hz = 0.0f, slew_hz = 0.0f;  // slew_hz: of the plane, sqrt(limit^2 - f^2)
static int8_t direction = 1;
static int64_t turns_x = 0, turns_y = 0;  // in 1e-12 revolutions
static float current_ua[COILS];
static uint32_t updated_us = 0;

static float radians_of(uint32_t angle) { return (float)(int32_t)angle * (float)(2.0 * M_PI / 4294967296.0); }

// ---- Output

static void put_out(const float *microamperes) {
  for (int c = 0; c < COILS; c++) {
    current_ua[c] = microamperes[c];
    write_coil(c, microamperes[c]);
  }
}

static void zero(char why) {
  static const float none[COILS] = {0.0f};
  armed = false;
  why_off = why;
  amplitude_ut = target_ut = frequency_hz = slew_hz = 0.0f;
  put_out(none);
}

// The field moves as flowrec/stages/control/field_rotation.py describes.
static void advance(float dt_s) {
  int32_t turn = (int32_t)(heading - plane);
  direction = 1;
  if (amplitude_ut <= 0.0f) {
    plane = heading;
    turn = 0;
  } else if (turn > QUARTER || turn < -QUARTER) {
    turn = (int32_t)((uint32_t)turn + HALF);
    direction = -1;
  }
  const float step = frequency_hz * dt_s;  // in turns
  const uint32_t before = phase;
  const uint32_t advanced = (uint32_t)(int64_t)(step * TURN);
  phase = direction > 0 ? phase + advanced : phase - advanced;
  const float travel = direction * (amplitude_ut > 0.0f ? step : 0.0f) * 1e12f;
  const uint32_t plane_before = plane;
  if (turn != 0) {
    const float slew = slew_hz * dt_s * TURN;
    // A field that points up or down has no plane: there the rest of the turn is applied.
    const bool vertical = (phase ^ before) & HALF || ((before & (HALF - 1)) == 0);
    if (vertical || slew >= fabsf((float)turn)) {
      plane += (uint32_t)turn;
    } else {
      plane += (uint32_t)(turn > 0 ? (int32_t)slew : -(int32_t)slew);
    }
  }
  const float mean = radians_of(plane_before + (uint32_t)((int32_t)(plane - plane_before) / 2));
  turns_x += (int64_t)(travel * cosf(mean));
  turns_y += (int64_t)(travel * sinf(mean));
  const float change = ramp_ut_s * dt_s;
  if (amplitude_ut < target_ut) {
    amplitude_ut = amplitude_ut + change < target_ut ? amplitude_ut + change : target_ut;
  } else if (amplitude_ut > target_ut) {
    amplitude_ut = amplitude_ut - change > target_ut ? amplitude_ut - change : target_ut;
  }
}

static void update() {
  const float up = cosf(radians_of(phase)), across = sinf(radians_of(phase));
  const float along = across * cosf(radians_of(plane)), beside = across * sinf(radians_of(plane));
  const float weight = amplitude_ut < fade_ut ? amplitude_ut / fade_ut : 1.0f;
  float wanted[COILS], largest = 0.0f;
  for (int c = 0; c < COILS; c++) {
    const float per_mt = up * vector_ua[0][c] + along * vector_ua[1][c] + beside * vector_ua[2][c];
    wanted[c] = 1e-3f * amplitude_ut * per_mt - weight * vector_ua[3][c];
    if (fabsf(wanted[c]) > largest) largest = fabsf(wanted[c]);
  }
  if (!(largest <= limit_ua)) {  // also for a number that is none
    const float less = largest > 0.0f && isfinite(largest) ? limit_ua / largest : 0.0f;
    for (int c = 0; c < COILS; c++) wanted[c] = less > 0.0f ? wanted[c] * less : 0.0f;
  }
  put_out(wanted);
}

// ---- Lines

static char line[64 + 12 * COILS];
static uint8_t length = 0;
static bool overlong = false;
static char reply[124 + 24 * COILS];
static char waiting[3 * sizeof reply];  // replies that are not sent yet
static size_t waiting_count = 0;

static uint16_t crc16(const char *text, size_t count) {  // CCITT-FALSE: polynomial 0x1021, begins with 0xffff
  uint16_t crc = 0xffff;
  while (count--) {
    crc ^= (uint16_t)((uint8_t)*text++) << 8;
    for (int bit = 0; bit < 8; bit++) crc = crc & 0x8000 ? (uint16_t)(crc << 1) ^ 0x1021 : (uint16_t)(crc << 1);
  }
  return crc;
}

static void add(char character) {
  const size_t n = strlen(reply);
  if (n + 1 < sizeof reply) {
    reply[n] = character;
    reply[n + 1] = 0;
  }
}

static void begin_reply(char verb) {
  reply[0] = verb;
  reply[1] = 0;
}

static void add_unsigned(uint32_t value) {
  char digits[11];
  int n = 10;
  digits[10] = 0;
  do {
    digits[--n] = (char)('0' + value % 10);
    value /= 10;
  } while (value);
  add(' ');
  for (; digits[n]; n++) add(digits[n]);
}

static void add_number(int32_t value) {
  add_unsigned(value < 0 ? 0UL - (uint32_t)value : (uint32_t)value);
  if (value < 0) {  // "-" between the blank and the digits
    char *blank = strrchr(reply, ' ');
    if (strlen(reply) + 2 < sizeof reply) {
      memmove(blank + 2, blank + 1, strlen(blank));
      blank[1] = '-';
    }
  }
}

static void add_text(const char *text) {
  add(' ');
  while (*text) add(*text++);
}

static void send() {
  static const char *hex = "0123456789ABCDEF";
  const uint16_t crc = crc16(reply, strlen(reply));
  add('*');
  for (int shift = 12; shift >= 0; shift -= 4) add(hex[(crc >> shift) & 15]);
  add('\n');
  const size_t count = strlen(reply);
  if (waiting_count + count > sizeof waiting) return;  // nobody reads
  memcpy(waiting + waiting_count, reply, count);
  waiting_count += count;
}

// Writes what fits, because on some boards Serial.write waits for a host that has stopped reading.
static void drain() {
  size_t count = waiting_count;
  const int room = count ? Serial.availableForWrite() : 0;
  if (room <= 0) return;
  if ((size_t)room < count) count = (size_t)room;
  Serial.write((const uint8_t *)waiting, count);
  waiting_count -= count;
  memmove(waiting, waiting + count, waiting_count);
}

static void refuse(int32_t seq, const char *why) {
  begin_reply('E');
  add_number(seq);
  add_text(why);
  send();
}

static int32_t millionths(uint32_t angle) { return (int32_t)(((uint64_t)angle * 1000000ULL) >> 32); }

static uint32_t angle_of(int32_t of_a_turn) { return (uint32_t)((int64_t)of_a_turn * 4294967296LL / 1000000LL); }

static void telemetry(int32_t seq) {
  begin_reply('F');
  add_number(seq);
  add_unsigned(updated_us);
  add_number((int32_t)(frequency_hz * 1000.0f + 0.5f));
  add_number(millionths(direction > 0 ? plane : plane + HALF));
  add_number((int32_t)(amplitude_ut + 0.5f));
  add_number(millionths(phase));
  add_number(millionths(plane));
  add_number((int32_t)(uint32_t)(turns_x / 1000000LL));
  add_number((int32_t)(uint32_t)(turns_y / 1000000LL));
  for (int c = 0; c < COILS; c++) add_number((int32_t)current_ua[c]);
  for (int c = 0; c < SENSORS; c++) add_number(measured_ua(c));
  send();
}

static void obey(char verb, int32_t seq, const int32_t *given, int count) {
  if (verb == 'I') {
    begin_reply('I');
    add_number(seq);
    add_text(MODEL);
    add_number(1);  // of the protocol
    add_number(MAX_UA);
    add_number(TIMER_MS);
    add_number(1000000L / (long)UPDATE_US);
    if (COILS != 3 || SENSORS) add_number(COILS);
    if (SENSORS) add_number(SENSORS);
    send();
  } else if (verb == 'V' && count == COILS + 1 && given[0] >= 0 && given[0] < 4 && !armed) {
    for (int c = 0; c < COILS; c++) vector_ua[given[0]][c] = (float)given[c + 1];
    configured |= (uint8_t)(1 << given[0]);
    begin_reply('V');
    add_number(seq);
    send();
  } else if (verb == 'L' && count == 2 && given[0] > 0 && given[1] > 0 && !armed) {
    if (given[0] > MAX_UA) {
      refuse(seq, "limit");
      return;
    }
    limit_ua = (float)given[0];
    fade_ut = (float)given[1];
    configured |= 0x10;
    begin_reply('L');
    add_number(seq);
    send();
  } else if (verb == 'A' && count == 0) {
    if (configured != COMPLETE) {
      refuse(seq, "configuration");
      return;
    }
    armed = true;
    begin_reply('A');
    add_number(seq);
    send();
  } else if (verb == 'F' && count == 5 && given[0] >= 0 && given[2] >= 0 && given[3] >= 0 && given[4] >= 0) {
    if (!armed) {
      refuse(seq, why_off == 'T' ? "timer" : "off");
      return;
    }
    frequency_hz = 1e-3f * (float)given[0];
    heading = angle_of(given[1]);
    target_ut = (float)given[2];
    const float most_hz = 1e-3f * (float)given[3];
    slew_hz = most_hz > frequency_hz ? sqrtf(most_hz * most_hz - frequency_hz * frequency_hz) : 0.0f;
    ramp_ut_s = (float)given[4];
    telemetry(seq);
  } else {
    refuse(seq, "arguments");
  }
}

static void take_line() {
  line[length] = 0;
  if (length == 1 && line[0] == 'Z') {  // always obeyed, also from a terminal, after any half line
    zero('Z');
    begin_reply('Z');
    send();
    return;
  }
  if (length < 7 || line[length - 5] != '*') {
    if (length) refuse(-1, "line");
    return;
  }
  if ((uint16_t)strtoul(line + length - 4, NULL, 16) != crc16(line, (size_t)(length - 5))) {
    refuse(-1, "checksum");
    return;
  }
  line[length - 5] = 0;
  static const int MOST = COILS + 2 > 6 ? COILS + 2 : 6;  // numbers of a line
  int32_t given[MOST];
  int count = 0;
  char *rest = line + 1, *end = rest;
  for (; count < MOST; count++, rest = end) {
    const long value = strtol(rest, &end, 10);
    if (end == rest) break;
    given[count] = (int32_t)value;
  }
  if (*rest || count == 0) {
    refuse(-1, "arguments");
    return;
  }
  if (line[0] == 'I') last_seq = -1;  // a new recorder
  if (given[0] <= last_seq) {         // an old line that comes late
    refuse(given[0], "sequence");
    return;
  }
  last_seq = given[0];
  heard_ms = millis();
  obey(line[0], given[0], given + 1, count - 1);
}

// ---- Arduino

void setup() {
  begin_outputs();
  zero('B');
  Serial.begin(BAUD);
  updated_us = micros();
}

void loop() {
  while (Serial.available() > 0) {
    const int character = Serial.read();
    if (character == '\n') {
      if (!overlong) take_line();
      length = 0;
      overlong = false;
    } else if (character == '\r') {
      continue;
    } else if (length + 1 < (int)sizeof line) {
      line[length++] = (char)character;
    } else {
      overlong = true;
    }
  }
  drain();
#if TIMER_MS > 0
  if (armed && millis() - heard_ms >= (uint32_t)TIMER_MS) zero('T');
#endif
  const uint32_t now_us = micros();
  const uint32_t elapsed_us = now_us - updated_us;
  if (elapsed_us < UPDATE_US) return;
  updated_us = now_us;
  if (!armed) return;
  advance(1e-6f * (float)elapsed_us);
  update();
}
