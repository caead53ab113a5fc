// RSP/1, the pump's line protocol, and what the pump must do about it. Plain C++11: no heap, no library, no clock of its
// own, so the sketch, the native build and the fuzzer run the very same lines.
//
//   host   @SS BODY*CCCC\n        SS hex sequence number, CCCC CRC-16/IBM-3740 of everything between @ and *
//   device #SS OK ...*CCCC\n  or  #SS ER CODE*CCCC\n, and of its own accord  !NAME u=MS f=FAULT*CCCC\n
//
// The owner feeds bytes to `receive`, calls `poll` at least every few milliseconds, and applies `duty` after either.
// docs/pump.md describes every command, state and fault.
#pragma once
#include <stdint.h>

#define RSP_FIRMWARE "0.1.0"

namespace rsp {

enum State : uint8_t { IDLE = 0, ARMED = 1, RUN = 2, FAULT = 3 };
enum Fault : uint8_t { NO_FAULT = 0, HOST_SILENT = 1, EMERGENCY_STOP = 2, DEVICE_RESET = 3, LEVEL_LOW = 4 };

const uint8_t LINE_MAX = 80;  // bytes of a line, from @ to the line feed
const uint8_t STOP_BYTE = 0x18;
const uint16_t WATCHDOG_MIN_MS = 200, WATCHDOG_MAX_MS = 2000;
const uint32_t RUN_MAX_MS = 600000;
const uint16_t PULSE_MAX_MS = 60000;
const uint32_t COUNT_MODULUS = 10000000;  // the counters b and x, so that a line holds them
const uint16_t LEVEL_SETTLE_MS = 500;  // water sloshes; a float switch must be open for so long

uint16_t crc16(const char* data, uint8_t length);

class Core {
 public:
  typedef void (*Write)(void* context, const char* data, uint8_t length);

  // max_duty: the largest duty that RN may ask for, per mille. after_watchdog_reset: the chip's own watchdog had to
  // restart it; that is a fault which a person has to clear.
  Core(Write write, void* context, uint16_t max_duty = 1000);
  void begin(uint32_t now_ms, bool after_watchdog_reset);

  void receive(uint8_t byte, uint32_t now_ms);
  void poll(uint32_t now_ms, bool level_low);

  uint16_t duty() const { return duty_; }  // per mille, to be applied now
  State state() const { return state_; }
  Fault fault() const { return fault_; }
  uint32_t bad_frames() const { return bad_; }
  uint32_t executed() const { return executed_; }

 private:
  struct Segment {
    uint32_t duty, ramp, on, off, duration;
  };

  void handle_line(uint32_t now);
  void execute(const char* body, const char* end, uint32_t now);
  bool execute_hello(const char* at, const char* end);
  void execute_arm(const char* at, const char* end, uint32_t now);
  void execute_run(const char* at, const char* end, uint32_t now);
  void latch(Fault fault, uint32_t now);
  void stop(State next);
  void update(uint32_t now);

  void begin_reply(const char* word);
  void put(const char* text);
  void put_number(char key, uint32_t value);
  void put_state();
  void error(const char* code);
  void finish(bool keep);
  void event(const char* name, uint32_t now);

  Write write_;
  void* context_;
  uint16_t max_duty_;

  State state_;
  Fault fault_;
  uint8_t faults_;  // how often one latched, modulo 256
  uint16_t duty_, from_;
  uint16_t watchdog_;
  uint32_t fed_, started_;
  Segment segment_;
  bool level_was_low_;
  uint32_t level_since_;

  bool collecting_;
  uint8_t length_;
  char line_[LINE_MAX];

  bool session_;
  uint8_t seq_, last_seq_, last_faults_;
  uint16_t last_crc_;
  uint8_t reply_length_, out_length_;
  char reply_[LINE_MAX], out_[LINE_MAX];

  uint32_t bad_, executed_;
};

}  // namespace rsp
