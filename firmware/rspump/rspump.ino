// The rig's pump on an Arduino with an ATmega328P (Uno, Nano). Everything about the protocol is in rsp_core; here are
// only the pins, the clock, and the chip's own watchdog. Wiring: docs/pump.md.
//
//   D9  (OC1A)  gate of the MOSFET, 1 kHz, with a pull-down that holds the pump off whenever the pin does not drive it
//   D7          float switch to ground: closed while there is water (D7 unconnected reads as empty)
//   D13         LED: lit while armed or running, blinking in a fault
#include <avr/wdt.h>

#include "rsp_core.h"

const uint8_t PUMP_PIN = 9, LEVEL_PIN = 7, LED_PIN = 13;
const uint16_t PUMP_MAX_DUTY = 1000;  // lower it for a pump that must not run at its supply's full voltage

// Why the chip restarted. A bootloader may have cleared MCUSR; Optiboot then hands it over in r2.
uint8_t reset_from_register __attribute__((section(".noinit")));
void keep_reset_cause() __attribute__((naked, used, section(".init0")));
void keep_reset_cause() { asm volatile("sts reset_from_register, r2\n"); }

void send(void*, const char* data, uint8_t length) {
  Serial.write(reinterpret_cast<const uint8_t*>(data), length);
}

rsp::Core core(send, nullptr, PUMP_MAX_DUTY);

// Timer 1, phase correct, counts to 1000 and back at 2 MHz: 1 kHz, OCR1A is the duty in per mille. At 0 the pin is taken
// from the timer and held low.
void apply(uint16_t duty) {
  if (duty == 0) {
    TCCR1A = _BV(WGM11);
    digitalWrite(PUMP_PIN, LOW);
    OCR1A = 0;
  } else {
    OCR1A = duty;
    TCCR1A = _BV(COM1A1) | _BV(WGM11);
  }
}

void setup() {
  const uint8_t cause = MCUSR != 0 ? MCUSR : reset_from_register;
  MCUSR = 0;
  wdt_enable(WDTO_120MS);  // a main loop that hangs restarts the chip; meanwhile its pins float and the pull-down holds
  digitalWrite(PUMP_PIN, LOW);
  pinMode(PUMP_PIN, OUTPUT);
  pinMode(LEVEL_PIN, INPUT_PULLUP);
  pinMode(LED_PIN, OUTPUT);
  TCCR1B = _BV(WGM13) | _BV(CS11);
  ICR1 = 1000;
  apply(0);
  Serial.begin(115200);
  core.begin(millis(), cause & _BV(WDRF));
}

void loop() {
  wdt_reset();
  const uint32_t now = millis();
  for (uint8_t i = 0; i < 32 && Serial.available(); ++i) core.receive(static_cast<uint8_t>(Serial.read()), now);
  core.poll(now, digitalRead(LEVEL_PIN) == HIGH);
  static uint16_t applied = 0;
  if (core.duty() != applied) apply(applied = core.duty());
  digitalWrite(LED_PIN, core.state() == rsp::FAULT ? (now & 256) != 0 : core.state() != rsp::IDLE);
}
