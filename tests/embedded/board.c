/* The closed loop of an exported controller on a Cortex-M4F in QEMU: one line a step, told through semihosting.
 *
 * A line is: step, state, input as the bits of floats, status, and the ticks that the step took. With -icount shift=0 an
 * instruction lasts 1 ns and SysTick counts 25 MHz, so a tick is 40 instructions. */
#include <stdint.h>

#include "koopmpc.h"
#include "plant.h"

extern uint32_t _data_from, _data, _data_end, _bss, _bss_end, _stack;

#define SYSTICK ((volatile uint32_t *)0xE000E010)
#define CPACR (*(volatile uint32_t *)0xE000ED88)
#define PAINT 0xA5A5A5A5u

static int semihosting(int what, const void *argument) {
  register int r0 __asm__("r0") = what;
  register const void *r1 __asm__("r1") = argument;
  __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}

static void say(uint32_t word, char end) {
  char text[10];
  for (int i = 0; i < 8; i++) text[i] = "0123456789abcdef"[(word >> (28 - 4 * i)) & 15u];
  text[8] = end;
  text[9] = 0;
  semihosting(4, text);
}

static void say_number(koopmpc_real number, char end) {
  union {
    koopmpc_real number;
    uint32_t bits;
  } both;
  both.number = number;
  say(both.bits, end);
}

static koopmpc_state controller;

static void loop(void) {
  koopmpc_real x[PLANT_NX], next[PLANT_NX], y[KOOPMPC_NY], u[KOOPMPC_NU];
  koopmpc_report report;
  for (int i = 0; i < PLANT_NX; i++) x[i] = plant_x0[i];
  koopmpc_init(&controller, KOOPMPC_NX == PLANT_NX ? plant_x0 : 0, 0);
  for (int k = 0; k < PLANT_STEPS; k++) {
    const int ahead = k < PLANT_ROWS ? k : PLANT_ROWS - 1;
    const koopmpc_rows reference = {plant_reference + ahead * KOOPMPC_NR, PLANT_ROWS - ahead};
    uint32_t start;
    plant_measure(x, y);
    SYSTICK[2] = 0;
    start = SYSTICK[2];
    koopmpc_step(&controller, y, &reference, 0, 0, u, &report);
    start = (start - SYSTICK[2]) & 0xFFFFFFu;
    say((uint32_t)k, ' ');
    for (int i = 0; i < PLANT_NX; i++) say_number(x[i], ' ');
    for (int i = 0; i < KOOPMPC_NU; i++) say_number(u[i], ' ');
    say((uint32_t)report.status, ' ');
    say(start, '\n');
    plant_step(x, u, next);
    for (int i = 0; i < PLANT_NX; i++) x[i] = next[i];
  }
}

void reset(void) {
  uint32_t *from = &_data_from;
  CPACR |= 0xFu << 20; /* the floating-point unit */
  __asm__ volatile("dsb\nisb");
  for (uint32_t *to = &_data; to < &_data_end;) *to++ = *from++;
  for (uint32_t *to = &_bss; to < &_bss_end;) *to++ = 0;
  for (uint32_t *to = &_bss_end; to < &_stack - 64;) *to++ = PAINT; /* to see how deep the stack has been */
  SYSTICK[1] = 0xFFFFFFu;
  SYSTICK[2] = 0;
  SYSTICK[0] = 5; /* on, from the processor's clock */
  loop();
  {
    uint32_t *low = &_bss_end;
    while (*low == PAINT) low++;
    semihosting(4, "stack ");
    say((uint32_t)((char *)&_stack - (char *)low), '\n');
  }
  semihosting(0x18, (void *)0x20026); /* the application has ended */
  for (;;) {
  }
}

void fault(void) {
  semihosting(4, "fault\n");
  semihosting(0x18, (void *)0x20023);
  for (;;) {
  }
}

__attribute__((section(".vectors"), used)) const void *const vectors[16] = {
    &_stack, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault,
};
