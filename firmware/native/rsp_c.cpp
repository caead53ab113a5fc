// The core behind plain C functions, for callers that bring their own clock (Python's ctypes).
#include <string>
#include <vector>

#include "../rspump/rsp_core.h"

namespace {

struct Device {
  std::string out;
  std::vector<uint16_t> applied;  // every duty that a byte or the time led to
  rsp::Core core;
  explicit Device(uint16_t max_duty) : core(&Device::write, this, max_duty) {}
  static void write(void* self, const char* data, uint8_t length) {
    static_cast<Device*>(self)->out.append(data, length);
  }
  void note() {
    if (applied.empty() || applied.back() != core.duty()) applied.push_back(core.duty());
  }
};

}  // namespace

extern "C" {

void* rsp_new(uint16_t max_duty, uint32_t now_ms, int after_watchdog_reset) {
  Device* device = new Device(max_duty);
  device->core.begin(now_ms, after_watchdog_reset != 0);
  return device;
}

void rsp_free(void* device) { delete static_cast<Device*>(device); }

void rsp_receive(void* device, const uint8_t* bytes, uint32_t count, uint32_t now_ms) {
  for (uint32_t i = 0; i < count; ++i) {
    static_cast<Device*>(device)->core.receive(bytes[i], now_ms);
    static_cast<Device*>(device)->note();
  }
}

void rsp_poll(void* device, uint32_t now_ms, int level_low) {
  static_cast<Device*>(device)->core.poll(now_ms, level_low != 0);
  static_cast<Device*>(device)->note();
}

// Moves at most `room` bytes of what the device has sent into `bytes`; returns how many.
uint32_t rsp_take(void* device, char* bytes, uint32_t room) {
  std::string& out = static_cast<Device*>(device)->out;
  const uint32_t count = static_cast<uint32_t>(out.copy(bytes, room));
  out.erase(0, count);
  return count;
}

// Moves at most `room` of the duties that were applied since the last call into `duties`; returns how many.
uint32_t rsp_applied(void* device, uint16_t* duties, uint32_t room) {
  std::vector<uint16_t>& applied = static_cast<Device*>(device)->applied;
  const uint32_t count = applied.size() < room ? static_cast<uint32_t>(applied.size()) : room;
  for (uint32_t i = 0; i < count; ++i) duties[i] = applied[i];
  applied.erase(applied.begin(), applied.begin() + count);
  return count;
}

uint16_t rsp_duty(void* device) { return static_cast<Device*>(device)->core.duty(); }
uint8_t rsp_state(void* device) { return static_cast<Device*>(device)->core.state(); }
uint8_t rsp_fault(void* device) { return static_cast<Device*>(device)->core.fault(); }
uint32_t rsp_bad_frames(void* device) { return static_cast<Device*>(device)->core.bad_frames(); }
uint32_t rsp_executed(void* device) { return static_cast<Device*>(device)->core.executed(); }

}  // extern "C"
