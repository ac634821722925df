/* What takes time, written once and compiled for each set of instructions: `page_code.c` includes this file for each.
 *
 * LANES: checks of a row that are renewed together. TARGET: attribute of the functions. NAME(x): their names.
 * Where the compiler knows no vectors, LANES is 1 and a vector is a number.
 */

#if LANES > 1
typedef float NAME(floats) __attribute__((vector_size(4 * LANES)));
typedef int32_t NAME(ints) __attribute__((vector_size(4 * LANES)));
#define LESS(a, b) ((a) < (b))
#define EQUAL(a, b) ((a) == (b))
#else
typedef float NAME(floats);
typedef int32_t NAME(ints);
#define LESS(a, b) (-(int32_t)((a) < (b)))
#define EQUAL(a, b) (-(int32_t)((a) == (b)))
#endif

typedef union {
  NAME(floats) f;
  NAME(ints) i;
} NAME(vector);

#define CHOSEN(mask, a, b) (((mask) & (a).i) | (~(mask) & (b).i))

/* Renews one row: beliefs are read at `in` and written to `out`, which are other places. Two vectors at a time, since
 * each step of one waits for its last. */
TARGET static void NAME(renew)(int degree, int z, float offset, const float *const *in, float *const *out, float *messages) {
  NAME(vector) other[MOST_DEGREE][2];
  for (int k = 0; k < z; k += 2 * LANES) {
    NAME(vector) least[2], second[2], sign[2], low[2], high[2];
    for (int p = 0; p < 2; p++) {
      least[p].f = second[p].f = (NAME(floats)){0} + FAR;
      sign[p].i = (NAME(ints)){0};
    }
    for (int i = 0; i < degree; i++)
      for (int p = 0; p < 2; p++) {
        NAME(vector) v, message, size, larger;
        memcpy(&v, in[i] + k + p * LANES, sizeof v);
        memcpy(&message, messages + i * z + k + p * LANES, sizeof message);
        v.f -= message.f;
        other[i][p] = v;
        sign[p].i ^= v.i;
        size.i = v.i & 0x7fffffff;
        const NAME(ints) is_less = LESS(size.f, least[p].f);
        larger.i = CHOSEN(is_less, least[p], size);
        least[p].i = CHOSEN(is_less, size, least[p]);
        second[p].i = CHOSEN(LESS(larger.f, second[p].f), larger, second[p]);
      }
    for (int p = 0; p < 2; p++) {
      low[p].f = least[p].f - offset, high[p].f = second[p].f - offset;
      low[p].i &= ~(low[p].i >> 31), high[p].i &= ~(high[p].i >> 31); /* what is negative becomes 0 */
    }
    for (int i = 0; i < degree; i++)
      for (int p = 0; p < 2; p++) {
        NAME(vector) v = other[i][p], size, told;
        size.i = v.i & 0x7fffffff;
        told.i = CHOSEN(EQUAL(size.f, least[p].f), high[p], low[p]) | ((sign[p].i ^ v.i) & INT32_MIN);
        memcpy(messages + i * z + k + p * LANES, &told, sizeof told);
        v.f += told.f;
        memcpy(out[i] + k + p * LANES, &v, sizeof v);
      }
  }
}

TARGET static void NAME(clip)(float *values, int count, float most) {
  for (int i = 0; i < count; i++) {
    const float above = values[i] > -most ? values[i] : -most;
    values[i] = above < most ? above : most;
  }
}

TARGET static void NAME(decide)(uint8_t *hard, const float *belief, int count) {
  for (int k = 0; k < count; k++) hard[k] = belief[k] < 0;
}

TARGET static int NAME(is_odd)(const uint8_t *const *hard, int degree, int z) {
  uint8_t sum[MOST_Z] = {0}, any = 0;
  for (int i = 0; i < degree; i++)
    for (int k = 0; k < z; k++) sum[k] ^= hard[i][k];
  for (int k = 0; k < z; k++) any |= sum[k];
  return any;
}

TARGET static inline void NAME(locate_even)(const levels_table *t, int count, const double *phase, int *place, double *away) {
  for (int i = 0; i < count; i++) {
    const double nearest = (phase[i] / t->step + WHOLE) - WHOLE;
    away[i] = phase[i] - nearest * t->step;
    place[i] = (int)nearest & (t->levels - 1);
  }
}

TARGET static inline void NAME(locate_uneven)(const levels_table *t, int count, const double *phase, int *place, double *away) {
  for (int i = 0; i < count; i++) {
    place[i] = place_of(&t->places, phase[i]);
    const double way = phase[i] - t->circle[place[i]], whole = (way / TURN + WHOLE) - WHOLE;
    away[i] = way - whole * TURN;
  }
}

TARGET static inline void NAME(polynomials)(const levels_table *t, int count, const double *away, const double *concentration, double *along, double *across) {
  double square[TILE], sine[TILE], cosine[TILE];
  for (int i = 0; i < count; i++) square[i] = away[i] * away[i], sine[i] = t->sine[t->terms - 1], cosine[i] = t->cosine[t->terms - 1];
  for (int n = t->terms - 2; n >= 0; n--) {
    const double s = t->sine[n], c = t->cosine[n];
    for (int i = 0; i < count; i++) {
      sine[i] = sine[i] * square[i] + s;
      cosine[i] = cosine[i] * square[i] + c;
    }
  }
  for (int i = 0; i < count; i++) {
    along[i] = concentration[i] * cosine[i];
    across[i] = concentration[i] * (sine[i] * away[i]);
  }
}

TARGET static inline float NAME(weight)(double along, double across, double cosine, double sine) {
  double x = along * cosine + across * sine;
  x = x > -80.0 ? x : -80.0;
  x = x < 0.0 ? x : 0.0;
  return exponential((float)x);
}

TARGET static inline void NAME(weigh)(int width, const double *cosine, const double *sine, double along, double across, float *weight) {
  for (int j = 0; j < width; j++) weight[j] = NAME(weight)(along, across, cosine[j], sine[j]);
}

/* LLRs of two label bits by the near neighbours, where cosets follow each other: what the general way below gives. The
 * sums of two neighbouring cosets are all that is needed, and which of them belong to which bit turns with the place. */
TARGET static void NAME(two_bits)(const levels_table *t, int count, const int *place, const double *along, const double *across, float most, float *out) {
  const double *cosine = t->near.cosine, *sine = t->near.sine;
  float sum[4][TILE], difference[2][TILE];
  if (t->even) {
    for (int r = 0; r < 4; r++)
      for (int i = 0; i < count; i++) {
        float total = NAME(weight)(along[i], across[i], cosine[r], sine[r]);
        total += NAME(weight)(along[i], across[i], cosine[r + 4], sine[r + 4]);
        total += NAME(weight)(along[i], across[i], cosine[r + 8], sine[r + 8]);
        total += NAME(weight)(along[i], across[i], cosine[r + 12], sine[r + 12]);
        sum[r][i] = total;
      }
  } else {
    for (int i = 0; i < count; i++) {
      float weight[NEAR];
      NAME(weigh)(NEAR, cosine + place[i] * NEAR, sine + place[i] * NEAR, along[i], across[i], weight);
      for (int r = 0; r < 4; r++) sum[r][i] = ((weight[r] + weight[r + 4]) + weight[r + 8]) + weight[r + 12];
    }
  }
  for (int r = 0; r < 2; r++)
    for (int i = 0; i < count; i++) {
      const float one = sum[r][i] + sum[r + 1][i], other = sum[r + 2][i] + sum[(r + 3) & 3][i];
      const float d = logarithm(one > TINY ? one : TINY) - logarithm(other > TINY ? other : TINY), above = d > -most ? d : -most;
      difference[r][i] = above < most ? above : most;
    }
  for (int i = 0; i < count; i++) {
    const int first = (place[i] + t->turn + t->levels - NEAR / 2) & 3;
    const float even = difference[0][i], odd = difference[1][i];
    const float low = first & 1 ? even : odd, high = first & 1 ? odd : even;
    out[2 * i] = first < 2 ? -low : low;
    out[2 * i + 1] = first == 1 || first == 2 ? -high : high;
  }
}

TARGET static void NAME(ratios)(const levels_table *t, int count, const double *phase, const double *concentration, float most, float *out) {
  double away[TILE], along[TILE], across[TILE];
  float zero[TILE * MOST_BITS], one[TILE * MOST_BITS], weight[MOST_LEVELS], coset[MOST_LEVELS];
  int place[TILE], far = 0;
  if (t->even)
    NAME(locate_even)(t, count, phase, place, away);
  else
    NAME(locate_uneven)(t, count, phase, place, away);
  NAME(polynomials)(t, count, away, concentration, along, across);
  for (int i = 0; i < count; i++) far |= !(concentration[i] >= t->limit[t->even ? 0 : place[i]]);
  if (!far && t->turn >= 0 && t->bits == 2 && t->near.width == NEAR) {
    NAME(two_bits)(t, count, place, along, across, most, out);
    return;
  }
  for (int i = 0; i < count; i++) {
    const int row = t->even ? 0 : place[i];
    const neighbours *n = concentration[i] >= t->limit[row] ? &t->near : &t->all;
    NAME(weigh)(n->width, n->cosine + row * n->width, n->sine + row * n->width, along[i], across[i], weight);
    sum_by_coset(t, n, place[i], weight, coset);
    split(t->bits, coset, zero + t->bits * i, one + t->bits * i);
  }
  for (int i = 0; i < count * t->bits; i++) {
    const float ratio = logarithm(zero[i]) - logarithm(one[i]);
    out[i] = ratio < -most ? -most : ratio > most ? most : ratio;
  }
}

TARGET static int64_t NAME(lack_of_truth)(int64_t count, const float *llrs, const uint8_t *bits) {
  int64_t sum = 0;
  for (int64_t i = 0; i < count; i++) {
    const float right = bits[i] ? -llrs[i] : llrs[i], size = fabsf(right) < 80.0f ? fabsf(right) : 80.0f;
    const float lack = right < 0 ? size : 0;
    sum += (int32_t)((lack + logarithm(1.0f + exponential(-size))) * UNITS);
  }
  return sum;
}

TARGET static int64_t NAME(lack_as_claimed)(int64_t count, const float *llrs) {
  int64_t sum = 0;
  for (int64_t i = 0; i < count; i++) {
    const float size = fabsf(llrs[i]) < 80.0f ? fabsf(llrs[i]) : 80.0f, tail = exponential(-size);
    sum += (int32_t)((logarithm(1.0f + tail) + size * tail / (1.0f + tail)) * UNITS);
  }
  return sum;
}

TARGET static void NAME(numbers_in_coset)(int count, const double *phase, const uint8_t *number, int bits, int levels, uint8_t *out) {
  const double step = TURN / levels, wide = step * (1 << bits);
  for (int i = 0; i < count; i++) {
    const double nearest = ((phase[i] - number[i] * step) / wide + WHOLE) - WHOLE;
    out[i] = (uint8_t)((int)nearest & ((levels >> bits) - 1));
  }
}

TARGET static void NAME(numbers_by_search)(int count, const double *phase, const uint8_t *number, const search *cosets, const uint8_t *order, uint8_t *out) {
  for (int i = 0; i < count; i++) {
    const search *own = cosets + number[i];
    out[i] = order[number[i] * own->levels + place_of(own, phase[i])];
  }
}

static const kernels NAME(kernels) = {NAME(renew), NAME(clip), NAME(decide), NAME(is_odd), NAME(ratios), NAME(lack_of_truth), NAME(lack_as_claimed), NAME(numbers_in_coset), NAME(numbers_by_search)};

#undef LESS
#undef EQUAL
#undef CHOSEN
