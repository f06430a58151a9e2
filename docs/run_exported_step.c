/* Run an exported control step from C, or in the same way from C++.
 *
 *     cc docs/run_exported_step.c step-.../step.o -Istep-... -lm -o run_exported_step
 *     ./run_exported_step
 *
 * The arm moves as it is told; a real loop would read its joints and write to its driver.
 */

#include <stdio.h>
#include <string.h>
#include <time.h>

#include "step.h"

#define DT 0.002 /* the step that was exported [s] */
#define JOINTS 7
#define STEPS 1000

static double state[STATE_ROWS], observation[OBSERVATION_ROWS], command[COMMAND_ROWS];
static double workspace[WORKSPACE_SIZE];

int main(void) {
  memcpy(state, first_state, sizeof state);
  memcpy(observation, first_observation, sizeof observation);
  double *q = observation + OBSERVATION_JOINT_POSITION;
  const double *velocity = command + COMMAND_JOINT_VELOCITY;

  const clock_t began = clock();
  for (int step = 0; step < STEPS; ++step) {
    control_step(state, observation, command, workspace, STEP_ARMS, STEP_ARMS);
    for (int i = 0; i < JOINTS; ++i) q[i] += DT * velocity[i];
  }
  const double seconds = (double)(clock() - began) / CLOCKS_PER_SEC;

  printf("joints at");
  for (int i = 0; i < JOINTS; ++i) printf(" %.9f", q[i]);
  printf("\nmean step %.1f us\n", 1e6 * seconds / STEPS);
  return 0;
}
