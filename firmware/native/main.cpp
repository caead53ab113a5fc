// The pump's firmware as a program: the sketch's protocol core on a pseudo-terminal, in real time.
//
//   rspump_native [--link PATH] [--trace FILE] [--max-duty N] [--corrupt PPM] [--drop PPM] [--insert PPM] [--seed N]
//
// Prints the port's name and runs until its standard input ends. --trace writes a line `monotonic_ns device_ms duty
// state fault` at each change. --corrupt, --drop and --insert spoil that many bytes in a million, both ways.
// SIGUSR1: the reservoir runs low; SIGUSR2: it was filled.
#include <poll.h>
#include <signal.h>
#include <string.h>
#include <time.h>

#include "../rspump/rsp_core.h"
#include "line_noise.h"
#include "pseudo_terminal.h"

namespace {

volatile sig_atomic_t level_low = 0, finished = 0;

void on_signal(int number) {
  if (number == SIGUSR1) level_low = 1;
  else if (number == SIGUSR2) level_low = 0;
  else finished = 1;
}

int64_t monotonic_ns() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return static_cast<int64_t>(t.tv_sec) * 1000000000 + t.tv_nsec;
}

struct Line {
  PseudoTerminal terminal;
  LineNoise noise;
  static void write(void* self, const char* data, uint8_t length) {
    Line* line = static_cast<Line*>(self);
    const std::string sent = line->noise(data, length);
    line->terminal.send(sent.data(), sent.size());
  }
};

struct Options {
  std::string link, trace;
  uint32_t max_duty = 1000, corrupt = 0, drop = 0, insert = 0, seed = 1;
};

bool parse(int count, char** words, Options& options) {
  struct { const char* name; uint32_t* number; std::string* text; } known[] = {
      {"--link", nullptr, &options.link},        {"--trace", nullptr, &options.trace},
      {"--max-duty", &options.max_duty, nullptr}, {"--corrupt", &options.corrupt, nullptr},
      {"--drop", &options.drop, nullptr},        {"--insert", &options.insert, nullptr},
      {"--seed", &options.seed, nullptr}};
  for (int i = 1; i < count; i += 2) {
    bool found = false;
    for (auto& each : known) {
      if (strcmp(words[i], each.name) != 0 || i + 1 == count) continue;
      found = true;
      if (each.text) *each.text = words[i + 1];
      else *each.number = static_cast<uint32_t>(strtoul(words[i + 1], nullptr, 10));
    }
    if (!found) {
      fprintf(stderr, "rspump_native: unknown option, or one without a value: %s\n", words[i]);
      return false;
    }
  }
  return true;
}

}  // namespace

int main(int count, char** words) {
  Options options;
  if (!parse(count, words, options)) return 2;
  FILE* trace = options.trace.empty() ? nullptr : fopen(options.trace.c_str(), "we");
  Line line;
  if (!line.terminal.open(options.link) || (!options.trace.empty() && !trace)) {
    perror("rspump_native");
    return 1;
  }
  line.noise.corrupt_ppm = options.corrupt;
  line.noise.drop_ppm = options.drop;
  line.noise.insert_ppm = options.insert;
  line.noise.state = options.seed * 0x9E3779B97F4A7C15ULL + 1;

  struct sigaction action;
  memset(&action, 0, sizeof action);
  action.sa_handler = on_signal;
  for (int number : {SIGUSR1, SIGUSR2, SIGTERM, SIGINT}) sigaction(number, &action, nullptr);

  rsp::Core core(&Line::write, &line, static_cast<uint16_t>(options.max_duty));
  const int64_t begun = monotonic_ns();
  core.begin(0, false);
  printf("%s\n", line.terminal.name.c_str());
  fflush(stdout);

  int shown[3] = {-1, -1, -1};
  const auto note = [&](int64_t now_ns, uint32_t now) {  // after every byte, so that no duty goes unseen
    const int seen[3] = {core.duty(), core.state(), core.fault()};
    if (!trace || memcmp(seen, shown, sizeof seen) == 0) return;
    fprintf(trace, "%lld %u %d %d %d\n", static_cast<long long>(now_ns), now, seen[0], seen[1], seen[2]);
    fflush(trace);
    memcpy(shown, seen, sizeof shown);
  };
  pollfd watched[2] = {{line.terminal.device, POLLIN, 0}, {0, POLLIN, 0}};
  while (!finished) {
    poll(watched, 2, 1);
    const int64_t now_ns = monotonic_ns();
    const uint32_t now = static_cast<uint32_t>((now_ns - begun) / 1000000);
    core.poll(now, level_low != 0);
    note(now_ns, now);
    char bytes[64];
    const ssize_t got = watched[0].revents & POLLIN ? read(line.terminal.device, bytes, sizeof bytes) : 0;
    if (got > 0) {
      for (const char byte : line.noise(bytes, static_cast<size_t>(got))) {
        core.receive(static_cast<uint8_t>(byte), now);
        note(now_ns, now);
      }
    }
    if (watched[1].revents && read(0, bytes, sizeof bytes) <= 0) finished = 1;
  }
  if (trace) fclose(trace);
  return 0;
}
