/** @file example.c @brief The closed loop of the controller and a plant, as a table. */
#include <stdio.h>

#include "koopmpc.h"
#include "plant.h"

static koopmpc_state controller; /* all that the controller needs besides its stack */

int main(void) {
  koopmpc_real x[PLANT_NX], next[PLANT_NX], y[KOOPMPC_NY];
  koopmpc_real acts[(KOOPMPC_LATENCY + 1) * KOOPMPC_NU]; /* an input acts KOOPMPC_LATENCY steps after its step */
  koopmpc_real *u = acts + KOOPMPC_LATENCY * KOOPMPC_NU;
  koopmpc_report report;
  int counts[9] = {0}, most = 0;
  for (int i = 0; i < PLANT_NX; i++) x[i] = plant_x0[i];
  for (int i = 0; i < (KOOPMPC_LATENCY + 1) * KOOPMPC_NU; i++) acts[i] = plant_u0[i % KOOPMPC_NU];
  koopmpc_init(&controller, KOOPMPC_NX == PLANT_NX ? plant_x0 : 0, plant_u0);
  printf("step");
  for (int i = 0; i < PLANT_NX; i++) printf(",x%d", i);
  for (int i = 0; i < KOOPMPC_NU; i++) printf(",u%d", i);
  printf(",status,fallback,iterations\n");
  for (int k = 0; k < PLANT_STEPS; k++) {
    const int ahead = k < PLANT_ROWS ? k : PLANT_ROWS - 1; /* the reference from this step on, its last row held */
    const koopmpc_rows reference = {plant_reference + ahead * KOOPMPC_NR, PLANT_ROWS - ahead};
    plant_measure(x, y);
    koopmpc_step(&controller, y, &reference, 0, 0, u, &report);
    printf("%d", k);
    for (int i = 0; i < PLANT_NX; i++) printf(",%.9g", (double)x[i]);
    for (int i = 0; i < KOOPMPC_NU; i++) printf(",%.9g", (double)u[i]);
    printf(",%d,%d,%d\n", (int)report.status, (int)report.fallback, report.iterations);
    counts[report.status]++;
    if (report.iterations > most) most = report.iterations;
    plant_step(x, acts, next);
    for (int i = 0; i < KOOPMPC_LATENCY * KOOPMPC_NU; i++) acts[i] = acts[i + KOOPMPC_NU];
    for (int i = 0; i < PLANT_NX; i++) x[i] = next[i];
  }
  fprintf(stderr, "%d steps: %d without a limit, %d solved, %d softened, %d other; at most %d iterations\n", PLANT_STEPS,
          counts[0] + counts[3], counts[1], counts[2], PLANT_STEPS - counts[0] - counts[1] - counts[2] - counts[3],
          most);
  return 0;
}
