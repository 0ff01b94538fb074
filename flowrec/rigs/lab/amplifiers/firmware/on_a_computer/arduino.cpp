// Runs a sketch on a computer, with its outputs as a file of samples.
//
//   twin pty FILE      in real time, behind a pseudo terminal whose name is printed. FILE gets a record for each change of
//                      the outputs: int64 CLOCK_MONOTONIC in ns, TWIN_COILS doubles (fractions of the full scale).
//   twin clock FILE    by the clock of the caller. On stdin: "> LINE" hands a line over, "+ US" lets time pass. What the
//                      sketch sends is printed; each "+" is answered with ".". FILE gets a record for every loop().
#include "Arduino.h"

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <deque>
#include <string>

SerialPort Serial;
static bool real_time;
static int terminal = -1;
static FILE *samples;
static int64_t clock_us = 1000;  // of `twin clock`
static std::deque<char> given;
static int duty[32], level[32];
static bool changed = true;

static int64_t monotonic_ns() {
  timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1000000000LL + now.tv_nsec;
}

static int64_t now_us() {
  static const int64_t start_us = monotonic_ns() / 1000;
  return real_time ? monotonic_ns() / 1000 - start_us : clock_us;
}

// The counter begins shortly before it wraps, as it does once in 71 minutes.
uint32_t micros() { return (uint32_t)now_us() - 3000000u; }
uint32_t millis() { return (uint32_t)(now_us() / 1000); }
void pinMode(int, int) {}
void digitalWrite(int pin, int now) { changed |= level[pin] != now, level[pin] = now; }
// The current of a coil as a fraction of the full scale. Where the file TWIN_FAULT exists, the first coil has half.
static double coil(int c) {
  static const char *fault = getenv("TWIN_FAULT");
  const double asked = (level[2 + TWIN_COILS + c] ? -1.0 : 1.0) * duty[2 + c] / PWM_FULL;
  return c == 0 && fault && !access(fault, F_OK) ? 0.5 * asked : asked;
}
int analogRead(int pin) { return SENSE_ZERO + (int)(coil(pin) * PWM_FULL); }  // the pin is the number of the coil
void analogWrite(int pin, int now) { changed |= duty[pin] != now, duty[pin] = now; }

void SerialPort::begin(long) {}
int SerialPort::available() {
  if (real_time && given.empty()) {
    char bytes[512];
    const ssize_t count = ::read(terminal, bytes, sizeof bytes);
    if (count > 0) given.insert(given.end(), bytes, bytes + count);
  }
  return (int)given.size();
}
int SerialPort::read() {
  if (available() == 0) return -1;
  const char first = given.front();
  given.pop_front();
  return (unsigned char)first;
}
int SerialPort::availableForWrite() { return real_time ? 64 : 4096; }
size_t SerialPort::write(const uint8_t *bytes, size_t count) {
  if (!real_time) return fwrite(bytes, 1, count, stdout);
  const ssize_t done = ::write(terminal, bytes, count);
  return done > 0 ? (size_t)done : 0;
}

static void record() {
  struct {
    int64_t at_ns;
    double coils[TWIN_COILS];
  } now = {real_time ? monotonic_ns() : clock_us * 1000, {0}};
  for (int c = 0; c < TWIN_COILS; c++) now.coils[c] = coil(c);
  fwrite(&now, sizeof now, 1, samples);
  changed = false;
}

static int behind_a_terminal() {
  terminal = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
  if (terminal < 0 || grantpt(terminal) || unlockpt(terminal)) return 1;
  // Held open, so that the terminal stays when its user closes it.
  const int other = open(ptsname(terminal), O_RDWR | O_NOCTTY);
  termios raw;
  tcgetattr(other, &raw);
  cfmakeraw(&raw);
  tcsetattr(other, TCSANOW, &raw);
  setvbuf(samples, NULL, _IONBF, 0);
  printf("%s\n", ptsname(terminal));
  fflush(stdout);
  // A board does not wait for the computer's other work.
  const sched_param first = {4};
  sched_setscheduler(0, SCHED_FIFO, &first);
  setup();
  const int owner = getppid();
  while (getppid() == owner) {
    loop();
    if (changed) record();
    pollfd waits = {terminal, POLLIN, 0};
    const timespec pause = {0, 100000};
    ppoll(&waits, 1, &pause, NULL);
  }
  return 0;
}

static int by_a_clock() {
  setup();
  char words[512];
  while (fgets(words, sizeof words, stdin)) {
    if (words[0] == '>') {
      given.insert(given.end(), words + 2, words + strlen(words));
      continue;
    }
    const int64_t end_us = clock_us + atoll(words + 1);
    while (clock_us < end_us) {
      clock_us += 200;
      loop();
      record();
    }
    fflush(samples);
    fputs(".\n", stdout);
    fflush(stdout);
  }
  return 0;
}

int main(int, char **words) {
  real_time = !strcmp(words[1], "pty");
  samples = fopen(words[2], "wb");
  return samples ? (real_time ? behind_a_terminal() : by_a_clock()) : 1;
}
