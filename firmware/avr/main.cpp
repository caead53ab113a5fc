// The sketch as built for an ATmega328P, on simavr's simulated chip, its UART on a pseudo-terminal, not faster than real
// time. Same output and trace as the native build: the duty is read from the timer's and the port's registers.
//
//   rspump_avr FIRMWARE.elf [--trace FILE] [--link PATH]
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

#include <deque>

#include "../native/pseudo_terminal.h"

extern "C" {
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
}

namespace {

const uint32_t CPU_HZ = 16000000;
const uint16_t DDRB = 0x24, PORTB = 0x25, TCCR1A = 0x80, OCR1AL = 0x88, OCR1AH = 0x89;

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

// What the pin does, per mille: nothing unless it is an output; the timer's duty if that drives it; else its level.
int duty(const avr_t* avr) {
  if (!(avr->data[DDRB] & 2)) return 0;
  if (!(avr->data[TCCR1A] & 0x80)) return avr->data[PORTB] & 2 ? 1000 : 0;
  return avr->data[OCR1AL] | (avr->data[OCR1AH] << 8);
}

struct Uart {
  PseudoTerminal terminal;
  std::deque<uint8_t> waiting;
  bool ready = true;
  avr_irq_t* input = nullptr;
  int64_t next_cycle = 0;
};

void on_byte(avr_irq_t*, uint32_t value, void* self) {
  const char byte = static_cast<char>(value);
  static_cast<Uart*>(self)->terminal.send(&byte, 1);
}
void on_ready(avr_irq_t*, uint32_t, void* self) { static_cast<Uart*>(self)->ready = true; }
void on_full(avr_irq_t*, uint32_t, void* self) { static_cast<Uart*>(self)->ready = false; }

}  // namespace

int main(int count, char** words) {
  std::string trace_path, link;
  for (int i = 2; i + 1 < count; i += 2) {
    if (strcmp(words[i], "--trace") == 0) trace_path = words[i + 1];
    if (strcmp(words[i], "--link") == 0) link = words[i + 1];
  }
  FILE* out = fdopen(dup(1), "w");  // simavr talks on standard output
  dup2(2, 1);
  elf_firmware_t firmware;
  memset(&firmware, 0, sizeof firmware);
  if (count < 2 || elf_read_firmware(words[1], &firmware) != 0) {
    fprintf(stderr, "rspump_avr: give the firmware's ELF file\n");
    return 2;
  }
  avr_t* avr = avr_make_mcu_by_name("atmega328p");
  FILE* trace = trace_path.empty() ? nullptr : fopen(trace_path.c_str(), "we");
  Uart uart;
  if (!avr || avr_init(avr) != 0 || !uart.terminal.open(link)) {
    fprintf(stderr, "rspump_avr: could not start\n");
    return 1;
  }
  avr->frequency = CPU_HZ;
  avr_load_firmware(avr, &firmware);
  avr->frequency = CPU_HZ;
  uint32_t flags = 0;
  avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
  flags &= ~static_cast<uint32_t>(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  uart.input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_byte, &uart);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), on_ready, &uart);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), on_full, &uart);
  avr_irq_t* level = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 7);

  struct sigaction action;
  memset(&action, 0, sizeof action);
  action.sa_handler = on_signal;
  for (int number : {SIGUSR1, SIGUSR2, SIGTERM, SIGINT}) sigaction(number, &action, nullptr);
  fprintf(out, "%s\n", uart.terminal.name.c_str());
  fflush(out);

  int shown = -1, seen = -1, settled = 0, shown_level = -1;
  int64_t begun = monotonic_ns();
  uint64_t slice = 0;
  while (!finished) {
    slice += CPU_HZ / 1000;
    while (avr->cycle < slice) {
      const int state = avr_run(avr);
      if (state == cpu_Done || state == cpu_Crashed) return 1;
      if (uart.ready && !uart.waiting.empty() && static_cast<int64_t>(avr->cycle) >= uart.next_cycle) {
        const uint8_t byte = uart.waiting.front();
        uart.waiting.pop_front();
        avr_raise_irq(uart.input, byte);
        uart.next_cycle = static_cast<int64_t>(avr->cycle) + CPU_HZ / 11520;  // a byte's time at 115,200 baud
      }
      const int now = duty(avr);
      settled = now == seen ? settled + 1 : 0;
      seen = now;
      if (trace && now != shown && settled >= 8) {  // a real timer takes both bytes of OCR1A at once, simavr's does not
        fprintf(trace, "%lld %llu %d 0 0\n", static_cast<long long>(monotonic_ns()),
                static_cast<unsigned long long>(avr->cycle / (CPU_HZ / 1000)), now);
        fflush(trace);
        shown = now;
      }
    }
    if (level_low != shown_level) avr_raise_irq(level, static_cast<uint32_t>(shown_level = level_low));
    char bytes[64];
    const ssize_t got = uart.waiting.size() < 4096 ? read(uart.terminal.device, bytes, sizeof bytes) : 0;
    for (ssize_t i = 0; i < got; ++i) uart.waiting.push_back(static_cast<uint8_t>(bytes[i]));
    pollfd input = {0, POLLIN, 0};
    if (poll(&input, 1, 0) > 0 && read(0, bytes, sizeof bytes) <= 0) finished = 1;
    const int64_t ahead = static_cast<int64_t>(slice) * 1000 / (CPU_HZ / 1000000) - (monotonic_ns() - begun);
    if (ahead > 0) {
      const timespec pause = {ahead / 1000000000, ahead % 1000000000};
      nanosleep(&pause, nullptr);
    } else if (ahead < -50000000) {
      begun = monotonic_ns() - static_cast<int64_t>(slice) * 1000 / (CPU_HZ / 1000000);  // too slow: do not catch up
    }
  }
  if (trace) fclose(trace);
  return 0;
}
