/** @file koopmpc_levels.h @brief Inputs on levels: which level each input holds, and the search for a sequence. */
#ifndef KOOPMPC_LEVELS_H
#define KOOPMPC_LEVELS_H

#include "koopmpc_common.h"

#if KOOPMPC_LEVELED
/** Start at the input u, from which each input may change at once. */
void koopmpc_start_levels(koopmpc_state *s, const koopmpc_real *u);

/** Count one step of the input u that acted. */
void koopmpc_count_levels(koopmpc_state *s, const koopmpc_real *u);

/** Put u on the nearest levels that dwell times and the rates since `before` allow; the limits of u win. */
void koopmpc_round_levels(const koopmpc_state *s, koopmpc_real *u, const koopmpc_real *before);

/** Whether the plan t is on levels and keeps its dwell times; its moves are then put on them. */
int koopmpc_accept_levels(koopmpc_state *s);

/**
 * Put the moves of t on the best sequence of levels.
 * @param s      the state; t is the plan without limits
 * @param low    limits of the rows of the program, less what they are for t
 * @param high   the same of the upper ends
 * @param report takes the sequences that were looked at, the gap, and how far a limit gave way
 */
koopmpc_status koopmpc_search_levels(koopmpc_state *s, const koopmpc_real *low, const koopmpc_real *high,
                                     koopmpc_report *report);
#endif

#endif
