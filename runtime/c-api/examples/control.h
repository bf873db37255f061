/* The part of a C firmware that runs a policy: no heap, no operating system. The board supplies `board_put`. */
#ifndef CONTROL_H
#define CONTROL_H

#include "gadm.h"

/* One character of text for people; from the board. */
void board_put(char c);

/* Loads and tests the policy at `image`. Prints why when it is refused. */
gadm_status control_start(const uint8_t *image, size_t len);

/* One step for each observation, first as floats, then as integers; prints a line for each. */
void control_run(const float *obs, size_t steps, const int16_t *obs_q, size_t steps_q);

#endif
