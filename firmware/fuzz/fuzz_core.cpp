// libFuzzer drives the core with raw bytes, well-framed commands, time, retries, emergency stops and a reservoir that
// empties, and checks after each step what must always hold. A second, independent account of when the pump may run
// (`Account`) is kept beside it.
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <string>

#include "../rspump/rsp_core.h"

namespace {

#define CHECK(condition)                                               \
  do {                                                                 \
    if (!(condition)) {                                                \
      fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition); \
      abort();                                                         \
    }                                                                  \
  } while (0)

// By polynomial division over the bits of the message, unlike the core's byte-wise shifting.
uint16_t crc_by_division(const std::string& text) {
  uint32_t remainder = 0xFFFF;
  for (const char c : text)
    for (int bit = 7; bit >= 0; --bit) {
      const uint32_t in = ((remainder >> 15) ^ (static_cast<uint8_t>(c) >> bit)) & 1;
      remainder = ((remainder << 1) & 0xFFFF) ^ (in ? 0x1021u : 0u);
    }
  return static_cast<uint16_t>(remainder);
}

std::string framed(char first, const std::string& text) {
  char tail[8];
  snprintf(tail, sizeof tail, "*%04X\n", crc_by_division(text));
  return first + text + tail;
}

// What the replies said, and so when the pump may run.
struct Account {
  std::string line;
  bool running = false;
  unsigned long long runs_until = 0, duty = 0;
  unsigned watchdog = 0;
  uint32_t now = 0, fed = 0;
  std::string sent_body;  // the command that the next reply answers
  bool fresh = false;     // it was no retry

  void hear(const char* data, size_t length) {
    CHECK(length >= 10 && length <= rsp::LINE_MAX && data[length - 1] == '\n');
    const std::string text(data, length);
    CHECK(text[0] == '#' || text[0] == '!');
    for (size_t i = 0; i + 1 < length; ++i) CHECK(text[i] >= 0x20 && text[i] <= 0x7E);
    CHECK(text == framed(text[0], text.substr(1, length - 7)));
    if (text[0] == '!' || !fresh) return;
    const std::string words = text.substr(4, length - 10);
    unsigned d, r, n, f, t, w;
    char tail;
    if (sscanf(words.c_str(), "OK d=%u r=%u n=%u f=%u t=%u%c", &d, &r, &n, &f, &t, &tail) == 5) {
      CHECK("RN" + words.substr(2) == sent_body);  // the echo is what was sent
      CHECK(d <= 1000 && t <= rsp::RUN_MAX_MS);
      running = true;
      duty = d > duty ? d : duty;
      runs_until = static_cast<unsigned long long>(now) + t;
      fed = now;
    } else if (sscanf(words.c_str(), "OK w=%u%c", &w, &tail) == 1) {
      CHECK(w >= rsp::WATCHDOG_MIN_MS && w <= rsp::WATCHDOG_MAX_MS);
      watchdog = w;
      fed = now;
    } else if (words.substr(0, 2) == "OK" && sent_body == "KA") {
      fed = now;
    } else if (words.substr(0, 2) == "OK" && (sent_body == "ST" || sent_body == "CL" || sent_body.substr(0, 2) == "HI")) {
      running = false;
    }
  }
};

struct Fuzzed {
  Account account;
  rsp::Core core;
  bool level_low = false, stopped = false;
  uint8_t seq = 0;
  std::string last;

  Fuzzed() : core(&Fuzzed::write, this) { core.begin(0, false); }
  static void write(void* self, const char* data, uint8_t length) {
    static_cast<Fuzzed*>(self)->account.hear(data, length);
  }

  void check() {
    if (core.duty() != 0) {
      CHECK(core.state() == rsp::RUN && core.fault() == rsp::NO_FAULT && account.running && !stopped);
      CHECK(core.duty() <= account.duty && account.now < account.runs_until);
      CHECK(account.now - account.fed < account.watchdog);
    }
    CHECK((core.state() == rsp::FAULT) == (core.fault() != rsp::NO_FAULT));
    if (core.state() != rsp::RUN) {
      account.running = false;
      account.duty = 0;
    }
  }

  void send(const std::string& bytes) {
    for (const char byte : bytes) {
      core.receive(static_cast<uint8_t>(byte), account.now);
      if (byte == rsp::STOP_BYTE) {
        CHECK(core.duty() == 0 && core.state() == rsp::FAULT);
        account.running = false;
      }
      check();
    }
  }

  void command(const std::string& body, int skip) {
    char head[8];
    seq = static_cast<uint8_t>(seq + 1 + skip);
    snprintf(head, sizeof head, "%02X ", seq);
    last = framed('@', head + body);
    const uint32_t executed = core.executed();
    account.sent_body = body;
    account.fresh = true;
    send(last);
    account.fresh = false;
    if (body == "CL" && core.executed() != executed) stopped = false;
    check();
  }

  void retry() {
    const uint32_t executed = core.executed();
    const uint16_t before = core.duty();
    if (last.empty()) return;
    account.sent_body.clear();
    send(last);
    if (last.size() > 5 && core.executed() == executed) CHECK(core.duty() <= before || core.state() == rsp::RUN);
  }

  // To the very millisecond at which the run or the host's time is over.
  void wait_for_boundary(bool of_run) {
    const unsigned long long at = of_run ? account.runs_until : static_cast<unsigned long long>(account.fed) + account.watchdog;
    if (at > account.now && at - account.now < 5000) wait(static_cast<uint32_t>(at - account.now));
  }

  void wait(uint32_t ms) {
    account.now += ms;
    core.poll(account.now, level_low);
    check();
  }
};

std::string take(const uint8_t*& data, size_t& size, size_t count) {
  count = count < size ? count : size;
  const std::string text(reinterpret_cast<const char*>(data), count);
  data += count;
  size -= count;
  return text;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  Fuzzed fuzzed;
  while (size > 0) {
    const uint8_t what = *data++;
    --size;
    const std::string next = take(data, size, what & 8 ? 2 : 0);
    const uint32_t number = next.size() == 2 ? static_cast<uint32_t>(static_cast<uint8_t>(next[0]) * 256 + static_cast<uint8_t>(next[1])) : what;
    char body[80];
    switch (what & 7) {
      case 0: fuzzed.send(take(data, size, (what >> 4) * 8u + 1)); break;
      case 1: fuzzed.command(take(data, size, (what >> 4) * 4u + 1), 0); break;  // well framed, whatever it says
      case 2: {
        static const char* const bare[] = {"KA", "ST", "QS", "CL", "HI v=1 n=00AF", "AR w=500", "AR w=1000", "AR w=2000"};
        fuzzed.command(bare[(what >> 4) & 7], 0);
        break;
      }
      case 3:
        snprintf(body, sizeof body, "RN d=%u r=%u n=%u f=%u t=%u", number % 1003, what & 16 ? number % 700 : 0,
                 what & 32 ? number % 300 + 1 : 0, what & 32 ? number % 777 + 1 : 0, what & 64 ? number * 10 : number);
        fuzzed.command(body, 0);
        break;
      case 4:
        if (what & 32) fuzzed.wait_for_boundary(what & 64);
        else fuzzed.wait(what & 16 ? number : number % 50);
        break;
      case 5: fuzzed.retry(); break;
      case 6:
        fuzzed.send(std::string(1, static_cast<char>(rsp::STOP_BYTE)));
        fuzzed.stopped = true;
        break;
      default:
        if (what & 16) fuzzed.level_low = !fuzzed.level_low;
        else if (what & 128) fuzzed.send("@" + std::string(number % 200, static_cast<char>('A' + number % 26)));
        else fuzzed.command("KA", (what >> 5) & 3);
    }
  }
  fuzzed.level_low = false;
  for (int i = 0; i < 25; ++i) fuzzed.wait(100);  // silence: whatever happened before, the pump is off
  CHECK(fuzzed.core.duty() == 0 && fuzzed.core.state() != rsp::RUN);
  return 0;
}
