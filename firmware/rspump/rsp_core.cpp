#include "rsp_core.h"

#include <string.h>

namespace rsp {

namespace {

int8_t hex_digit(char c) {
  if (c >= '0' && c <= '9') return static_cast<int8_t>(c - '0');
  if (c >= 'A' && c <= 'F') return static_cast<int8_t>(c - 'A' + 10);
  return -1;
}

// Upper-case hex digits only; false if there is anything else.
bool read_hex(const char* at, uint8_t digits, uint16_t& value) {
  value = 0;
  for (uint8_t i = 0; i < digits; ++i) {
    const int8_t digit = hex_digit(at[i]);
    if (digit < 0) return false;
    value = static_cast<uint16_t>((value << 4) | static_cast<uint16_t>(digit));
  }
  return true;
}

void write_hex(char* at, uint8_t digits, uint16_t value) {
  for (uint8_t i = 0; i < digits; ++i) {
    const uint8_t digit = (value >> (4 * (digits - 1 - i))) & 15;
    at[i] = static_cast<char>(digit < 10 ? '0' + digit : 'A' + digit - 10);
  }
}

// " k=123" at `at`: a decimal number without leading zeros, low..high; moves `at` behind it.
bool take(const char*& at, const char* end, char key, uint32_t low, uint32_t high, uint32_t& value) {
  if (end - at < 4 || at[0] != ' ' || at[1] != key || at[2] != '=') return false;
  const char* digit = at + 3;
  if (*digit == '0' && digit + 1 < end && digit[1] != ' ') return false;
  value = 0;
  const char* first = digit;
  while (digit < end && *digit != ' ') {
    if (*digit < '0' || *digit > '9' || digit - first >= 7) return false;
    value = value * 10 + static_cast<uint32_t>(*digit - '0');
    ++digit;
  }
  if (digit == first || value < low || value > high) return false;
  at = digit;
  return true;
}

}  // namespace

uint16_t crc16(const char* data, uint8_t length) {
  uint16_t crc = 0xFFFF;
  for (uint8_t i = 0; i < length; ++i) {
    crc = static_cast<uint16_t>(crc ^ (static_cast<uint16_t>(static_cast<uint8_t>(data[i])) << 8));
    for (uint8_t bit = 0; bit < 8; ++bit)
      crc = static_cast<uint16_t>((crc & 0x8000) ? (crc << 1) ^ 0x1021 : crc << 1);
  }
  return crc;
}

Core::Core(Write write, void* context, uint16_t max_duty)
    : write_(write), context_(context), max_duty_(max_duty), state_(IDLE), fault_(NO_FAULT), faults_(0), duty_(0),
      from_(0), watchdog_(WATCHDOG_MIN_MS), fed_(0), started_(0), segment_(), level_was_low_(false), level_since_(0),
      collecting_(false), length_(0), line_(), session_(false), seq_(0), last_seq_(0), last_faults_(0), last_crc_(0),
      reply_length_(0), out_length_(0), reply_(), out_(), bad_(0), executed_(0) {}

void Core::begin(uint32_t now, bool after_watchdog_reset) {
  if (after_watchdog_reset) latch(DEVICE_RESET, now);
  else event("UP", now);
}

// -- the line ---------------------------------------------------------------------------------------------------------

void Core::receive(uint8_t byte, uint32_t now) {
  if (byte == STOP_BYTE) {
    collecting_ = false;
    latch(EMERGENCY_STOP, now);
  } else if (byte == '@') {  // always begins a line, whatever came before
    if (collecting_) ++bad_;
    collecting_ = true;
    length_ = 0;
  } else if (!collecting_) {
    return;
  } else if (byte == '\n') {
    collecting_ = false;
    update(now);  // silence that is over its time is a fault, even if this line ends it before the next poll
    handle_line(now);
    update(now);
  } else if (byte < 0x20 || byte > 0x7E || length_ >= LINE_MAX - 2) {
    collecting_ = false;
    ++bad_;
  } else {
    line_[length_++] = static_cast<char>(byte);
  }
}

void Core::handle_line(uint32_t now) {
  uint16_t seq, crc;
  if (length_ < 9 || line_[2] != ' ' || line_[length_ - 5] != '*' || !read_hex(line_, 2, seq) ||
      !read_hex(line_ + length_ - 4, 4, crc) || crc16(line_, static_cast<uint8_t>(length_ - 5)) != crc) {
    ++bad_;
    return;
  }
  const char* body = line_ + 3;
  const char* end = line_ + length_ - 5;
  seq_ = static_cast<uint8_t>(seq);
  if (session_ && seq_ == last_seq_ && crc == last_crc_) {  // a retry: nothing is executed, no watchdog fed
    if (faults_ != last_faults_) {
      error("FLT");
      finish(false);
    } else {
      write_(context_, reply_, reply_length_);
    }
    return;
  }
  const bool hello = end - body >= 2 && body[0] == 'H' && body[1] == 'I' && (end - body == 2 || body[2] == ' ');
  if (hello) {
    if (!execute_hello(body + 2, end)) {
      finish(false);
      return;
    }
    session_ = true;
    ++executed_;
  } else if (!session_ || seq_ != static_cast<uint8_t>(last_seq_ + 1)) {
    error("SEQ");
    finish(false);
    return;
  } else {
    execute(body, end, now);
  }
  last_seq_ = seq_;
  last_crc_ = crc;
  last_faults_ = faults_;
  finish(true);
}

// -- commands ---------------------------------------------------------------------------------------------------------

bool Core::execute_hello(const char* at, const char* end) {
  uint32_t version;
  uint16_t nonce;
  if (!take(at, end, 'v', 0, 9999999, version) || end - at != 7 || memcmp(at, " n=", 3) != 0 ||
      !read_hex(at + 3, 4, nonce)) {
    error("ARG");
    return false;
  }
  if (version != 1) {
    error("VER");
    return false;
  }
  stop(state_ == FAULT ? FAULT : IDLE);
  char digits[5] = {0, 0, 0, 0, 0};
  write_hex(digits, 4, nonce);
  begin_reply("OK");
  put_number('v', 1);
  put(" n=");
  put(digits);
  put(" fw=" RSP_FIRMWARE " id=RSPUMP");
  put_number('m', max_duty_);
  return true;
}

void Core::execute(const char* body, const char* end, uint32_t now) {
  const char* at = body + 2;
  const bool bare = at == end;
  if (end - body < 2 || (!bare && *at != ' ')) return error("CMD");
  const uint16_t name = static_cast<uint16_t>((static_cast<uint8_t>(body[0]) << 8) | static_cast<uint8_t>(body[1]));
  switch (name) {
    case ('A' << 8) | 'R': return execute_arm(at, end, now);
    case ('R' << 8) | 'N': return execute_run(at, end, now);
    case ('K' << 8) | 'A':
      if (!bare) return error("ARG");
      fed_ = now;
      break;
    case ('S' << 8) | 'T':
      if (!bare) return error("ARG");
      stop(state_ == FAULT ? FAULT : IDLE);
      break;
    case ('Q' << 8) | 'S':
      if (!bare) return error("ARG");
      break;
    case ('C' << 8) | 'L':
      if (!bare) return error("ARG");
      if (level_was_low_) return error("FLT");  // the reservoir must be filled first
      fault_ = NO_FAULT;
      stop(IDLE);
      break;
    default: return error("CMD");
  }
  ++executed_;
  update(now);
  begin_reply("OK");
  put_state();
  if (name == (('Q' << 8) | 'S')) {  // a run began at u - a on the device's clock
    put_number('w', watchdog_);
    put_number('a', state_ == RUN ? now - started_ : 0);
    put_number('u', now);
    put_number('b', bad_ % COUNT_MODULUS);
    put_number('x', executed_ % COUNT_MODULUS);
  }
}

void Core::execute_arm(const char* at, const char* end, uint32_t now) {
  uint32_t watchdog;
  if (!take(at, end, 'w', WATCHDOG_MIN_MS, WATCHDOG_MAX_MS, watchdog) || at != end) return error("ARG");
  if (state_ == FAULT) return error("FLT");
  if (state_ == RUN) return error("ARM");
  watchdog_ = static_cast<uint16_t>(watchdog);
  fed_ = now;
  state_ = ARMED;
  ++executed_;
  begin_reply("OK");
  put_number('w', watchdog_);
}

void Core::execute_run(const char* at, const char* end, uint32_t now) {
  Segment s;
  if (!take(at, end, 'd', 0, max_duty_, s.duty) || !take(at, end, 'r', 0, PULSE_MAX_MS, s.ramp) ||
      !take(at, end, 'n', 0, PULSE_MAX_MS, s.on) || !take(at, end, 'f', 0, PULSE_MAX_MS, s.off) ||
      !take(at, end, 't', 1, RUN_MAX_MS, s.duration) || at != end || (s.on == 0) != (s.off == 0) || s.ramp > s.duration)
    return error("ARG");
  if (state_ == FAULT) return error("FLT");
  if (state_ == IDLE) return error("ARM");
  from_ = duty_;  // ramps begin where the pump is
  segment_ = s;
  started_ = fed_ = now;
  state_ = RUN;
  ++executed_;
  begin_reply("OK");
  put_number('d', s.duty);
  put_number('r', s.ramp);
  put_number('n', s.on);
  put_number('f', s.off);
  put_number('t', s.duration);
}

// -- the pump ---------------------------------------------------------------------------------------------------------

void Core::poll(uint32_t now, bool level_low) {
  if (!level_low) {
    level_was_low_ = false;
    level_since_ = now;
  } else if (!level_was_low_ && now - level_since_ >= LEVEL_SETTLE_MS) {
    level_was_low_ = true;
    latch(LEVEL_LOW, now);
  }
  update(now);
}

// What the duty is now: silence, then the end of the run, then ramp and pulse.
void Core::update(uint32_t now) {
  if ((state_ == ARMED || state_ == RUN) && now - fed_ >= watchdog_) {
    if (state_ == RUN) {
      latch(HOST_SILENT, now);
    } else {
      stop(IDLE);
      event("DA", now);
    }
  }
  if (state_ != RUN) return;
  const uint32_t age = now - started_;
  if (age >= segment_.duration) {
    stop(ARMED);
    event("DN", now);
    return;
  }
  int32_t level = static_cast<int32_t>(segment_.duty);
  if (age < segment_.ramp)
    level = from_ + (level - from_) * static_cast<int32_t>(age) / static_cast<int32_t>(segment_.ramp);
  const bool pause = segment_.on != 0 && age % (segment_.on + segment_.off) >= segment_.on;
  duty_ = pause ? 0 : static_cast<uint16_t>(level);
}

void Core::latch(Fault fault, uint32_t now) {
  stop(FAULT);
  ++faults_;
  const bool first = fault_ == NO_FAULT;
  if (!first) return;  // the first cause is the one worth knowing
  fault_ = fault;
  const char* const names[] = {"NO", "WD", "ES", "RS", "LV"};
  event(names[fault], now);
}

void Core::stop(State next) {
  duty_ = 0;
  from_ = 0;
  state_ = next;
}

// -- replies ----------------------------------------------------------------------------------------------------------

void Core::begin_reply(const char* word) {
  out_[0] = '#';
  write_hex(out_ + 1, 2, seq_);
  out_[3] = ' ';
  out_length_ = 4;
  put(word);
}

void Core::put(const char* text) {
  while (*text && out_length_ < LINE_MAX - 6) out_[out_length_++] = *text++;
}

void Core::put_number(char key, uint32_t value) {
  char digits[11];
  uint8_t at = sizeof digits - 1;
  digits[at] = 0;
  do {
    digits[--at] = static_cast<char>('0' + value % 10);
    value /= 10;
  } while (value);
  const char head[] = {' ', key, '=', 0};
  put(head);
  put(digits + at);
}

void Core::put_state() {
  put_number('s', state_);
  put_number('d', duty_);
  put_number('f', fault_);
}

void Core::error(const char* code) {
  begin_reply("ER ");
  put(code);
}

void Core::finish(bool keep) {
  const uint16_t crc = crc16(out_ + 1, static_cast<uint8_t>(out_length_ - 1));
  out_[out_length_++] = '*';
  write_hex(out_ + out_length_, 4, crc);
  out_length_ = static_cast<uint8_t>(out_length_ + 4);
  out_[out_length_++] = '\n';
  if (keep) {
    memcpy(reply_, out_, out_length_);
    reply_length_ = out_length_;
  }
  write_(context_, out_, out_length_);
}

void Core::event(const char* name, uint32_t now) {
  // Never while a reply is being made, so they share its buffer.
  out_[0] = '!';
  out_length_ = 1;
  put(name);
  put_number('u', now);
  put_number('f', fault_);
  finish(false);
}

}  // namespace rsp
