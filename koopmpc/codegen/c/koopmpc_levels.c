/**
 * @file koopmpc_levels.c
 * @brief Inputs on levels: which level each input holds, and the search for the best sequence of levels.
 *
 * A plan costs 0.5 |s|^2 and its soft limits, and its first j moves depend on s_1 ... s_j alone. The search goes deep
 * first, to the nearest level first, and leaves beginnings that cost more than the best sequence.
 */
#include <math.h>

#include "koopmpc_levels_tables.h"
#include "koopmpc_step.h"

#if KOOPMPC_LEVELS
enum { NU = KOOPMPC_NU, COUNT = KOOPMPC_LEVELS_FREE_LENGTH, OTHERS = KOOPMPC_LEVELS_ROWS_LENGTH, OTHERS1 = OTHERS > 0 ? OTHERS : 1 };
enum { BLOCKS = KOOPMPC_MOVES / NU };

/*
 * Numbers that Python has, too: KOOPMPC_NEAR_LEVEL of the spacing from a level, an input is on it. A sequence is better
 * if it costs less than the share KOOPMPC_BETTER. An input that has held its level for KOOPMPC_FREE steps may change.
 */

/** A search at work: the sequence begun, its costs, and the levels that are still to be tried below and above. */
typedef struct {
  koopmpc_real s[COUNT], cost[COUNT + 1], centre[COUNT], best_s[COUNT], best, low[OTHERS1], high[OTHERS1];
  int index[COUNT], below[COUNT], above[COUNT], least[COUNT], most[COUNT], found[COUNT], has;
  int level[(COUNT + 1) * NU], steps[(COUNT + 1) * NU];
} search;

static koopmpc_real place_of(koopmpc_real u, int i) { return (u - koopmpc_levels_levels_first[i]) / koopmpc_levels_levels_spacing[i]; }

static koopmpc_real value_of(int level, int i) {
  return koopmpc_levels_levels_first[i] + koopmpc_levels_levels_spacing[i] * (koopmpc_real)level;
}

static int clip_level(koopmpc_real place, int i) {
  return (int)koopmpc_clip(place, 0, (koopmpc_real)(koopmpc_levels_levels_count[i] - 1));
}

static int nearest_level(koopmpc_real u, int i) { return clip_level(KOOPMPC_FN(rint)(place_of(u, i)), i); }

/** Steps for which input i has to hold a level. */
static int dwell_of(int level, int i) { return koopmpc_levels_levels_dwell[2 * i + (level != 0)]; }

/** The lowest and highest level of input i inside (low, high). */
static void levels_inside(koopmpc_real low, koopmpc_real high, int i, int *least, int *most) {
  const koopmpc_real last = (koopmpc_real)koopmpc_levels_levels_count[i];
  const koopmpc_real from = KOOPMPC_FN(ceil)(koopmpc_clip(place_of(low, i), -1, last) - KOOPMPC_NEAR_LEVEL);
  const koopmpc_real to = KOOPMPC_FN(floor)(koopmpc_clip(place_of(high, i), -1, last) + KOOPMPC_NEAR_LEVEL);
  *least = from > 0 ? (int)from : 0;
  *most = to < last - 1 ? (int)to : koopmpc_levels_levels_count[i] - 1;
}

void koopmpc_start_levels(koopmpc_state *s, const koopmpc_real *u) {
  for (int i = 0; i < NU; i++) {
    s->level[i] = nearest_level(u[i], i);
    s->level_steps[i] = KOOPMPC_FREE;
  }
  s->level_begins = 1;
  s->most_nodes = KOOPMPC_NODES;
}

void koopmpc_count_levels(koopmpc_state *s, const koopmpc_real *u) {
  for (int i = 0; i < NU; i++) {
    const int level = nearest_level(u[i], i), changed = level != s->level[i] && !s->level_begins;
    s->level_steps[i] = changed ? 1 : s->level_steps[i] < KOOPMPC_FREE ? s->level_steps[i] + 1 : KOOPMPC_FREE;
    s->level[i] = level;
  }
  s->level_begins = 0;
}

void koopmpc_round_levels(const koopmpc_state *s, koopmpc_real *u, const koopmpc_real *before) {
  for (int i = 0; i < NU; i++) {
    int level = nearest_level(u[i], i), least, most;
#if KOOPMPC_RATES
    levels_inside(before[i] + KOOPMPC_RATES_LOW(s)[i], before[i] + KOOPMPC_RATES_HIGH(s)[i], i, &least, &most);
    if (least <= most) level = level < least ? least : level > most ? most : level;
#else
    (void)before;
#endif
    if (s->level_steps[i] < dwell_of(s->level[i], i)) level = s->level[i];
    levels_inside(KOOPMPC_BOX_LOW(s)[i], KOOPMPC_BOX_HIGH(s)[i], i, &least, &most);
    level = level < least ? least : level;
    u[i] = value_of(level > most ? most : level, i);
  }
}

/** Whether a sequence of all moves keeps the dwell times. */
static int keeps_dwell(const koopmpc_state *s, const int *levels) {
  for (int i = 0; i < NU; i++) {
    int level = s->level[i], steps = s->level_steps[i];
    for (int k = 0; k < BLOCKS; k++) {
      const int next = levels[k * NU + i];
      if (next != level) {
        if (steps < dwell_of(level, i)) return 0;
        level = next;
        steps = 0;
      }
      steps += koopmpc_levels_blocks[k];
    }
  }
  return 1;
}

static void place_moves(koopmpc_state *s) {
  for (int at = 0; at < KOOPMPC_MOVES; at++) s->t[at] = value_of(s->plan_levels[at], at % NU);
  s->has_levels = 1;
}

int koopmpc_accept_levels(koopmpc_state *s) {
  int levels[KOOPMPC_MOVES];
  for (int at = 0; at < KOOPMPC_MOVES; at++) {
    const koopmpc_real place = place_of(s->t[at], at % NU);
    levels[at] = (int)KOOPMPC_FN(rint)(place);
    if (!(koopmpc_abs(place - (koopmpc_real)levels[at]) <= KOOPMPC_NEAR_LEVEL)) return 0;
  }
  if (!keeps_dwell(s, levels)) return 0;
  for (int at = 0; at < KOOPMPC_MOVES; at++) s->plan_levels[at] = levels[at];
  place_moves(s);
  return 1;
}

static int is_soft(int row) { return koopmpc_levels_linear[row] < KOOPMPC_HUGE; }

/** The value of a row by the first `count` coordinates, and where a move is by those before it. */
static koopmpc_real row_value(int row, const koopmpc_real *s, int count) {
  koopmpc_real sum = 0;
  for (int k = 0; k < count; k++) sum += koopmpc_levels_T[k * OTHERS + row] * s[k];
  return sum;
}

static koopmpc_real centre_of(const koopmpc_state *s, const koopmpc_real *coordinates, int j) {
  const int at = koopmpc_levels_free[j];
  koopmpc_real sum = place_of(s->t[at], at % NU);
  for (int k = 0; k < j; k++) sum += koopmpc_levels_L[k * COUNT + j] * coordinates[k];
  return sum;
}

/** Price of the rows that are known once the moves up to j are; negative where a hard one is outside. */
static koopmpc_real price(const search *now, const koopmpc_real *s, int j) {
  koopmpc_real sum = 0;
  for (int r = koopmpc_levels_first[j]; r < koopmpc_levels_first[j + 1]; r++) {
    const koopmpc_real value = row_value(r, s, j + 1);
    const koopmpc_real over = value - now->high[r], under = now->low[r] - value, past = over > under ? over : under;
    if (!(past > 0)) continue;
    if (!is_soft(r)) return -1;
    sum += past * (koopmpc_levels_linear[r] + past * koopmpc_levels_quadratic[r]);
  }
  return sum;
}

/** Remember the sequence of all moves as the best one. */
static void keep(search *now, koopmpc_real cost) {
  now->best = cost;
  now->has = 1;
  for (int j = 0; j < COUNT; j++) {
    now->found[j] = now->index[j];
    now->best_s[j] = now->s[j];
  }
}

/** Begin with the levels of the last plan, moved on by a step. */
static void guess(const koopmpc_state *s, search *now) {
  int levels[KOOPMPC_MOVES];
  koopmpc_real cost = 0;
  for (int at = 0; at < KOOPMPC_MOVES; at++) {
    const int next = at + NU < KOOPMPC_MOVES ? at + NU : at;
    levels[at] = s->plan_levels[next];
  }
  for (int j = 0; j < COUNT; j++) {
    const int level = levels[koopmpc_levels_free[j]];
    now->index[j] = level < now->least[j] ? now->least[j] : level > now->most[j] ? now->most[j] : level;
  }
  for (int at = 0; at < KOOPMPC_MOVES; at++) levels[at] = now->index[koopmpc_levels_group[at]];
  if (!keeps_dwell(s, levels)) return;
  for (int j = 0; j < COUNT; j++) {
    koopmpc_real paid;
    now->s[j] = ((koopmpc_real)now->index[j] - centre_of(s, now->s, j)) / koopmpc_levels_L[j * COUNT + j];
    paid = price(now, now->s, j);
    if (paid < 0) return;
    cost += (koopmpc_real)0.5 * now->s[j] * now->s[j] + paid;
  }
  keep(now, cost);
}

/** Look at move j: where it is if the later coordinates are zero, and the levels around. */
static void enter(const koopmpc_state *s, search *now, int j) {
  const koopmpc_real centre = centre_of(s, now->s, j);
  const koopmpc_real low = (koopmpc_real)(now->least[j] - 1), high = (koopmpc_real)now->most[j];
  now->centre[j] = centre;
  now->below[j] = (int)koopmpc_clip(KOOPMPC_FN(floor)(centre), low, high);
  now->above[j] = now->below[j] + 1;
}

/** What the nearest level that is left of move j costs, with all before; its level, or 1 below the lowest for none. */
static koopmpc_real next_cost(const search *now, int j, int *level) {
  const int below = now->below[j], above = now->above[j];
  const int has_below = below >= now->least[j], has_above = above <= now->most[j];
  const koopmpc_real down = now->centre[j] - (koopmpc_real)below, up = (koopmpc_real)above - now->centre[j];
  koopmpc_real s;
  *level = has_below && (!has_above || down <= up) ? below : has_above ? above : now->least[j] - 1;
  s = ((koopmpc_real)*level - now->centre[j]) / koopmpc_levels_L[j * COUNT + j];
  return now->cost[j] + (koopmpc_real)0.5 * s * s;
}

/** Search all sequences; return the least cost of those that are left where the search ends early. */
static koopmpc_real look(const koopmpc_state *s, search *now, int *nodes) {
  int j = 0;
  for (int i = 0; i < NU; i++) {
    now->level[i] = s->level[i];
    now->steps[i] = s->level_steps[i];
  }
  now->cost[0] = 0;
  enter(s, now, 0);
  while (j >= 0) {
    const int i = koopmpc_levels_free[j] % NU, *level = now->level + j * NU, *steps = now->steps + j * NU;
    int next, *to = now->level + (j + 1) * NU, *held = now->steps + (j + 1) * NU;
    koopmpc_real cost = next_cost(now, j, &next), paid;
    if (next < now->least[j] || (now->has && cost >= now->best * KOOPMPC_BETTER)) {
      j--;
      continue;
    }
    if (*nodes >= s->most_nodes) { /* what is left, on every move of the sequence begun */
      koopmpc_real bound = KOOPMPC_HUGE;
      for (; j >= 0; j--) {
        cost = next_cost(now, j, &next);
        if (next >= now->least[j] && cost < bound) bound = cost;
      }
      return bound;
    }
    if (next == now->below[j])
      now->below[j]--;
    else
      now->above[j]++;
    if (next != level[i] && steps[i] < dwell_of(level[i], i)) continue;
    ++*nodes;
    now->index[j] = next;
    now->s[j] = ((koopmpc_real)next - now->centre[j]) / koopmpc_levels_L[j * COUNT + j];
    paid = price(now, now->s, j);
    if (paid < 0) continue;
    cost += paid;
    if (now->has && cost >= now->best * KOOPMPC_BETTER) continue;
    if (j + 1 == COUNT) {
      keep(now, cost);
      continue;
    }
    for (int k = 0; k < NU; k++) {
      to[k] = level[k];
      held[k] = steps[k];
    }
    to[i] = next;
    held[i] = (next != level[i] ? 0 : steps[i]) + koopmpc_levels_steps[j];
    now->cost[++j] = cost;
    enter(s, now, j);
  }
  return KOOPMPC_HUGE;
}

koopmpc_status koopmpc_search_levels(koopmpc_state *s, const koopmpc_real *low, const koopmpc_real *high,
                                     koopmpc_report *report) {
  search now;
  koopmpc_real bound;
  int nodes = 0;
  now.best = 0;
  now.has = 0;
  for (int r = 0; r < OTHERS; r++) {
    const int row = koopmpc_levels_rows[r];
    const koopmpc_real below = low[row] / koopmpc_solver_rows[row], above = high[row] / koopmpc_solver_rows[row];
    const koopmpc_real near = koopmpc_abs(below) < koopmpc_abs(above) ? koopmpc_abs(below) : koopmpc_abs(above);
    const koopmpc_real reach = is_soft(r) ? 0 : KOOPMPC_WIDER * (1 + near);
    now.low[r] = below - reach;
    now.high[r] = above + reach;
  }
  for (int j = 0; j < COUNT; j++) {
    now.least[j] = 0;
    now.most[j] = koopmpc_levels_levels_count[koopmpc_levels_free[j] % NU] - 1;
  }
#if KOOPMPC_BOUNDS
  for (int at = 0; at < KOOPMPC_MOVES; at++) {
    const int j = koopmpc_levels_group[at];
    int least, most;
    levels_inside(s->box_low[at], s->box_high[at], at % NU, &least, &most);
    if (least > now.least[j]) now.least[j] = least;
    if (most < now.most[j]) now.most[j] = most;
  }
#endif
  if (s->has_levels) {
    guess(s, &now);
    nodes = now.has;
  }
  bound = look(s, &now, &nodes);
  report->iterations += nodes;
  s->has_levels = now.has;
  if (!now.has) return bound < KOOPMPC_HUGE ? KOOPMPC_MAX_ITERATIONS : KOOPMPC_INFEASIBLE;
  if (bound < now.best * KOOPMPC_BETTER) {
    const koopmpc_real least = bound > 0 ? bound : 0;
    report->gap = (now.best - least) / now.best;
  }
  for (int at = 0; at < KOOPMPC_MOVES; at++) s->plan_levels[at] = now.found[koopmpc_levels_group[at]];
  place_moves(s);
  for (int r = 0; r < OTHERS; r++) {
    const int row = koopmpc_levels_rows[r];
    const koopmpc_real value = row_value(r, now.best_s, COUNT);
    const koopmpc_real over = value - now.high[r], under = now.low[r] - value;
    const koopmpc_real past = (over > under ? over : under) / koopmpc_qp_scale[row];
    if (is_soft(r) && past > koopmpc_qp_softness_allowance[row] && past > report->slack) report->slack = past;
  }
  return KOOPMPC_OPTIMAL;
}
#endif
