/* The page code's arithmetic, compiled: min-sum decoding of LDPC blocks, LLRs of bits, their information, numbers within
 * cosets.
 *
 * Each function has a twin in numpy that is the reference: the same operations in the same order, so that both give the
 * same bits on every processor. Compile without contraction to fused operations and without -ffast-math.
 *
 * Arguments are contiguous buffers, whose types and sizes are checked before anything is read, and numbers. The global
 * lock is released while there is work. Indices come from the callers' tables and are checked here.
 */
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifdef _MSC_VER
#pragma fp_contract(off)
#endif

#if FLT_EVAL_METHOD != 0
#error "floating-point operations must be done in their own precision"
#endif

typedef union {
  float f;
  uint32_t u;
  int32_t i;
} bits32;

/* ---- limits of the code ---- */

#define MOST_Z 384
#define MOST_DEGREE 19
#define MOST_ROWS 46
#define MOST_EDGES 316
#define INFORMATION_GROUPS 22
#define PUNCTURED_GROUPS 2
#define MOST_GROUPS (INFORMATION_GROUPS + MOST_ROWS)
#define MOST_LANES 32 /* that a kernel takes at once */
#define FAR 1e30f

/* ---- exponentials and logarithms, as lightpage/codec/likelihood/arithmetic.py: the polynomials of Cephes ---- */

static inline float exponential(float x) { /* of -80 to 0 */
  bits32 turn, scale;
  turn.f = x * 1.44269504088896341f + 12582912.0f; /* 1.5 * 2^23: the sum is rounded to a whole number */
  const float n = turn.f - 12582912.0f;
  const float r = (x - n * 0.693359375f) - n * -2.12194440e-4f;
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * (r * r) + r;
  p = p + 1.0f;
  scale.u = (turn.u + 127u) << 23;
  return p * scale.f;
}

static inline float logarithm(float x) { /* of a positive number that is not denormal */
  bits32 v, exponent, part;
  v.f = x;
  exponent.u = (v.u - 0x3f3504f3u) & 0xff800000u; /* of x over sqrt(1/2) */
  part.u = v.u - exponent.u;
  const float n = (float)exponent.i * 1.1920928955078125e-7f; /* 2^-23 */
  const float r = part.f - 1.0f, square = r * r;
  float p = 7.0376836292e-2f;
  p = p * r + -1.1514610310e-1f;
  p = p * r + 1.1676998740e-1f;
  p = p * r + -1.2420140846e-1f;
  p = p * r + 1.4249322787e-1f;
  p = p * r + -1.6668057665e-1f;
  p = p * r + 2.0000714765e-1f;
  p = p * r + -2.4999993993e-1f;
  p = p * r + 3.3333331174e-1f;
  p = p * (r * square);
  p = p + n * -2.12194440e-4f;
  p = p - 0.5f * square;
  p = r + p;
  return p + n * 0.693359375f;
}

/* ---- LLRs of bits, as lightpage/codec/mapping.py ---- */

#define MOST_LEVELS 256
#define MOST_BITS 8
#define MOST_TERMS 20
#define NEAR 16
#define STEPS 4096
#define MOST_PHASE 1e6
#define TURN (2 * 3.14159265358979323846)
#define WHOLE 6755399441055744.0 /* 1.5 * 2^52: a sum with it is rounded to a whole number */
#define TINY 1.17549435e-38f
#define TILE 256

typedef struct {
  int width;            /* neighbours of each place, from width / 2 places before it on */
  const double *cosine; /* of the way to a neighbour, less 1: [rows, width] */
  const double *sine;
  const uint8_t *coset; /* of each place's neighbours, [levels, width]; nothing where cosets follow each other */
} neighbours;

/* What finds the nearest of uneven levels: see `Levels.borders` of lightpage/page/levels.py. */
typedef struct {
  int levels, most;
  double first;
  const double *borders;
  const int64_t *starts;
} search;

typedef struct {
  int levels, bits, cosets, even, terms;
  int turn; /* level at the first place, where levels follow each other on the circle; else -1 */
  double step;
  const double *sine, *cosine; /* coefficients of even powers, of the sine over its argument and of the cosine */
  const double *circle;
  search places;
  const double *limit; /* concentration from which the near neighbours suffice, [rows] */
  neighbours near, all;
} levels_table;

static inline int place_of(const search *s, double phase) {
  const double turns = (phase - s->first) / TURN, part = turns - floor(turns);
  int64_t found = s->starts[part >= 0 && part <= 1 ? (int)(part * STEPS) : 0];
  for (int i = 0; i < s->most; i++) found += found < s->levels - 1 && part > s->borders[found];
  return (int)found;
}

/* Sums of neighbours by coset, where cosets follow each other: those of the r-th, the r-th after the next `cosets` ... */
static inline void fold(int width, int cosets, const float *weight, float *sum) {
  const int few = width < cosets ? width : cosets;
  for (int r = 0; r < few; r++) sum[r] = weight[r];
  for (int j = cosets; j < width; j += cosets)
    for (int r = 0; r < cosets; r++) sum[r] += weight[j + r];
}

static inline void sum_by_coset(const levels_table *t, const neighbours *n, int place, const float *weight, float *coset) {
  if (t->turn < 0) {
    for (int c = 0; c < t->cosets; c++) coset[c] = 0;
    for (int j = 0; j < n->width; j++) coset[n->coset[place * n->width + j] & (t->cosets - 1)] += weight[j];
    return;
  }
  float sum[MOST_LEVELS];
  const int few = n->width < t->cosets ? n->width : t->cosets, first = place + t->turn + t->levels - n->width / 2;
  fold(n->width, t->cosets, weight, sum);
  if (few < t->cosets)
    for (int c = 0; c < t->cosets; c++) coset[c] = 0;
  for (int r = 0; r < few; r++) coset[(first + r) & (t->cosets - 1)] = sum[r];
}

/* Weights of each bit's being 0 and 1. Bit k of a Gray label is 1 in the middle two of every four runs of 2^k cosets. */
static inline void split(int bits, float *coset, float *zero, float *one) {
  for (int k = 0, runs = 1 << bits; k < bits; k++, runs >>= 1) {
    float z = 0, o = 0;
    for (int i = 0; i < runs; i++)
      if (((i >> 1) ^ i) & 1)
        o += coset[i];
      else
        z += coset[i];
    zero[k] = z > TINY ? z : TINY;
    one[k] = o > TINY ? o : TINY;
    for (int i = 0; i < runs / 2; i++) coset[i] = coset[2 * i] + coset[2 * i + 1];
  }
}

/* ---- one build for processors of several generations ---- */

#define UNITS 16777216.0f

typedef struct {
  void (*renew)(int, int, float, const float *const *, float *const *, float *);
  void (*clip)(float *, int, float);
  void (*decide)(uint8_t *, const float *, int);
  int (*is_odd)(const uint8_t *const *, int, int);
  void (*ratios)(const levels_table *, int, const double *, const double *, float, float *);
  int64_t (*lack_of_truth)(int64_t, const float *, const uint8_t *);
  int64_t (*lack_as_claimed)(int64_t, const float *);
  void (*numbers_in_coset)(int, const double *, const uint8_t *, int, int, uint8_t *);
  void (*numbers_by_search)(int, const double *, const uint8_t *, const search *, const uint8_t *, uint8_t *);
} kernels;

#define TARGET
#define NAME(x) x##_plain
#ifdef __GNUC__
#define LANES 4
#else
#define LANES 1
#endif
#include "kernels.h"
#undef TARGET
#undef NAME
#undef LANES

#if defined(__GNUC__) && defined(__x86_64__)
#define TARGET __attribute__((target("avx2")))
#define NAME(x) x##_avx2
#define LANES 8
#include "kernels.h"
#undef TARGET
#undef NAME
#undef LANES
#define TARGET __attribute__((target("avx512f,avx512bw,avx512dq,avx512vl")))
#define NAME(x) x##_avx512
#define LANES 16
#include "kernels.h"
#undef TARGET
#undef NAME
#undef LANES
#endif

static const kernels *const VARIANTS[] = {
    &kernels_plain,
#if defined(__GNUC__) && defined(__x86_64__)
    &kernels_avx2,
    &kernels_avx512,
#endif
};
static const char *const NAMES[] = {"plain", "avx2", "avx512"};

/* How many of the variants this processor has. */
static int variants(void) {
#if defined(__GNUC__) && defined(__x86_64__)
  __builtin_cpu_init();
  if (!__builtin_cpu_supports("avx2")) return 1;
  return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") ? 3 : 2;
#else
  return 1;
#endif
}

/* The variant that is used: the last that this processor has, unless a test chooses another. */
static const kernels *used = &kernels_plain;

/* ---- LDPC blocks: layered offset min-sum, as lightpage/codec/ldpc/decoder.py ---- */

typedef struct {
  int rows, z, groups, information, sent, edges, iterations;
  float offset, most, known;
  int degree[MOST_ROWS], column[MOST_EDGES], shift[MOST_EDGES];
} ldpc;

typedef struct {
  float *room, *beliefs, *messages;
  float *belief[MOST_GROUPS], *spare[MOST_DEGREE];
  int turned[MOST_GROUPS]; /* lane k of a group's beliefs is of its bit k + turned, modulo z */
  uint8_t *hard, *word;
} scratch;

static int padded(int z) { return (z + MOST_LANES - 1) / MOST_LANES * MOST_LANES; }

/* Beliefs of a group lie there twice, one after the other, so that z of them follow each other from any of the first z. */
static int length_of_group(int z) { return 2 * z + MOST_LANES; }

static int take_room(scratch *s, const ldpc *code) {
  const size_t group = (size_t)length_of_group(code->z), z = (size_t)padded(code->z);
  s->room = calloc(group * (size_t)(code->groups + MOST_DEGREE), sizeof(float));
  s->messages = malloc(z * (size_t)code->edges * sizeof(float));
  s->beliefs = malloc((size_t)code->groups * (size_t)code->z * sizeof(float));
  s->hard = malloc(2 * (size_t)code->groups * (size_t)code->z);
  s->word = malloc((size_t)code->groups * (size_t)code->z);
  return s->room && s->beliefs && s->messages && s->hard && s->word;
}

static void free_room(scratch *s) {
  free(s->room);
  free(s->beliefs);
  free(s->messages);
  free(s->hard);
  free(s->word);
}

/* Sent bits that stand before the fillers; the others are parity bits behind them. */
static int sent_before_fillers(const ldpc *code) {
  const int first = PUNCTURED_GROUPS * code->z;
  return code->information > first ? code->information - first : 0;
}

static void fill(scratch *s, const ldpc *code, const float *llrs) {
  const int z = code->z, group = length_of_group(z), first = PUNCTURED_GROUPS * z, fillers = INFORMATION_GROUPS * z;
  memset(s->messages, 0, sizeof(float) * (size_t)padded(z) * (size_t)code->edges);
  memset(s->beliefs, 0, sizeof(float) * (size_t)code->groups * (size_t)z);
  for (int i = code->information; i < fillers; i++) s->beliefs[i] = code->known;
  const int before = sent_before_fillers(code);
  memcpy(s->beliefs + first, llrs, sizeof(float) * (size_t)before);
  memcpy(s->beliefs + fillers, llrs + before, sizeof(float) * (size_t)(code->sent - before));
  used->clip(s->beliefs + first, before, code->most);
  used->clip(s->beliefs + fillers, code->sent - before, code->most);
  for (int g = 0; g < code->groups; g++) {
    s->belief[g] = s->room + g * group, s->turned[g] = 0;
    memcpy(s->belief[g], s->beliefs + g * z, sizeof(float) * (size_t)z);
  }
  for (int i = 0; i < MOST_DEGREE; i++) s->spare[i] = s->room + (code->groups + i) * group;
}

static int turn_of(const scratch *s, const ldpc *code, int edge) {
  const int turn = code->shift[edge] - s->turned[code->column[edge]];
  return turn < 0 ? turn + code->z : turn;
}

static void renew_row(scratch *s, const ldpc *code, int row, int edge) {
  const int z = code->z, degree = code->degree[row];
  const float *in[MOST_DEGREE];
  for (int i = 0; i < degree; i++) {
    float *belief = s->belief[code->column[edge + i]];
    const int turn = turn_of(s, code, edge + i);
    memcpy(belief + z, belief, sizeof(float) * (size_t)turn);
    in[i] = belief + turn;
  }
  used->renew(degree, padded(z), code->offset, in, s->spare, s->messages + edge * padded(z));
  for (int i = 0; i < degree; i++) {
    const int g = code->column[edge + i];
    float *renewed = s->spare[i];
    s->spare[i] = s->belief[g];
    s->belief[g] = renewed;
    s->turned[g] = code->shift[edge + i];
  }
}

static void decide(scratch *s, const ldpc *code, int g) {
  uint8_t *hard = s->hard + g * 2 * code->z;
  used->decide(hard, s->belief[g], code->z);
  memcpy(hard + code->z, hard, (size_t)code->z);
}

/* Whether all checks hold. Bits are decided as far as checks need them until one fails. */
static int all_even(scratch *s, const ldpc *code) {
  const uint8_t *hard[MOST_DEGREE];
  uint8_t decided[MOST_GROUPS] = {0};
  for (int r = 0, edge = 0; r < code->rows; edge += code->degree[r++]) {
    for (int i = 0; i < code->degree[r]; i++) {
      const int g = code->column[edge + i];
      if (!decided[g]) decide(s, code, g), decided[g] = 1;
      hard[i] = s->hard + g * 2 * code->z + turn_of(s, code, edge + i);
    }
    if (used->is_odd(hard, code->degree[r], code->z)) return 0;
  }
  return 1;
}

/* Decodes a block. Returns the iterations taken, 0 where a check still fails after the last. */
static int decode_block(scratch *s, const ldpc *code, const float *llrs, uint8_t *information, uint8_t *sent) {
  const int z = code->z, before = sent_before_fillers(code);
  int taken = 0;
  fill(s, code, llrs);
  for (int iteration = 1; iteration <= code->iterations && !taken; iteration++) {
    for (int r = 0, edge = 0; r < code->rows; edge += code->degree[r++]) renew_row(s, code, r, edge);
    if (all_even(s, code)) taken = iteration;
  }
  for (int g = 0; g < code->groups; g++) {
    decide(s, code, g);
    memcpy(s->word + g * z, s->hard + g * 2 * z + (z - s->turned[g]), (size_t)z);
  }
  memcpy(information, s->word, (size_t)code->information);
  memcpy(sent, s->word + PUNCTURED_GROUPS * z, (size_t)before);
  memcpy(sent + before, s->word + INFORMATION_GROUPS * z, (size_t)(code->sent - before));
  return taken;
}

/* ---- what Python calls ---- */

static int is_bounded(int64_t count, const double *values, double most) {
  int bad = 0;
  for (int64_t i = 0; i < count; i++) bad |= !(fabs(values[i]) <= most);
  return !bad;
}

/* Numbers of label bits that are a Gray code, the inverse of number ^ number >> 1. */
static void numbers_of_labels(int count, const uint8_t *label, int bits, uint8_t *out) {
  for (int i = 0; i < count; i++, label += bits) {
    int number = 0;
    for (int k = 0; k < bits; k++) number |= (label[k] & 1) << k;
    number ^= number >> 1;
    number ^= number >> 2;
    out[i] = (uint8_t)(number ^ number >> 4);
  }
}

/* The lowest `width` bits of numbers, a byte each, the highest first. */
static inline void bits_of_numbers(int count, const uint8_t *number, int width, uint8_t *out) {
  for (int i = 0; i < count; i++, out += width)
    for (int k = 0; k < width; k++) out[k] = (uint8_t)(number[i] >> (width - 1 - k) & 1);
}

/* What finds the levels of each coset, where levels are uneven. */
typedef struct {
  search of[MOST_LEVELS];
  const uint8_t *order; /* levels of each coset in the order of their places, [cosets, levels of a coset] */
} coset_searches;

static void upper_numbers(int64_t count, const double *phase, const uint8_t *label, int bits, int level_bits, const coset_searches *uneven, uint8_t *out) {
  const int width = level_bits - bits;
  uint8_t number[TILE], found[TILE];
  for (int64_t start = 0; start < count; start += TILE) {
    const int some = (int)(count - start < TILE ? count - start : TILE);
    if (bits == 2)
      numbers_of_labels(some, label + start * 2, 2, number);
    else
      numbers_of_labels(some, label + start * bits, bits, number);
    if (uneven)
      used->numbers_by_search(some, phase + start, number, uneven->of, uneven->order, found);
    else
      used->numbers_in_coset(some, phase + start, number, bits, 1 << level_bits, found);
    uint8_t *to = out + start * width;
    switch (width) {
      case 3: bits_of_numbers(some, found, 3, to); break;
      case 4: bits_of_numbers(some, found, 4, to); break;
      case 5: bits_of_numbers(some, found, 5, to); break;
      default: bits_of_numbers(some, found, width, to);
    }
  }
}

/* A contiguous buffer of a type's `count` elements, or of any number where count is negative. */
static int take_buffer(PyObject *from, Py_buffer *view, const char *name, const char *kinds, Py_ssize_t size, Py_ssize_t count, int writable) {
  if (PyObject_GetBuffer(from, view, PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0)) < 0) return -1;
  const char *format = view->format ? view->format : "B";
  if (view->itemsize != size || format[0] == 0 || format[1] != 0 || !strchr(kinds, format[0]) || (uintptr_t)view->buf % (size_t)size != 0) {
    PyErr_Format(PyExc_TypeError, "%s: got elements '%s' of %zd bytes, expected aligned ones of '%s', %zd bytes", name, format, view->itemsize, kinds, size);
  } else if (count >= 0 && view->len != count * size) {
    PyErr_Format(PyExc_ValueError, "%s: got %zd elements, expected %zd", name, view->len / size, count);
  } else {
    return 0;
  }
  PyBuffer_Release(view);
  return -1;
}

/* Buffers that a call has taken. */
typedef struct {
  Py_buffer view[16];
  int count;
} buffers;

static void *take(buffers *all, PyObject *from, const char *name, const char *kinds, Py_ssize_t size, Py_ssize_t count, int writable) {
  if (take_buffer(from, &all->view[all->count], name, kinds, size, count, writable) < 0) return NULL;
  return all->view[all->count++].buf;
}

static Py_ssize_t taken_elements(const buffers *all) { return all->view[all->count - 1].len / all->view[all->count - 1].itemsize; }

static void release(buffers *all) {
  while (all->count) PyBuffer_Release(&all->view[--all->count]);
}

static PyObject *ended(buffers *all, PyObject *result) {
  release(all);
  return result;
}

#define FLOATS(from, name, count, writable) take(all, from, name, "f", 4, count, writable)
#define DOUBLES(from, name, count) take(all, from, name, "d", 8, count, 0)
#define BYTES(from, name, count, writable) take(all, from, name, "B?", 1, count, writable)
#define INTS(from, name, count, writable) take(all, from, name, "il", 4, count, writable)
#define LONGS(from, name, count) take(all, from, name, "lq", 8, count, 0)

/* Copies the rows of a base graph: what is checked cannot change. */
static int take_graph(ldpc *code, const int32_t *degrees, Py_ssize_t rows, const int32_t *edges, Py_ssize_t count) {
  if (rows < 4 || rows > MOST_ROWS || count > MOST_EDGES) return -1;
  if (code->z < 1 || code->z > MOST_Z || code->information < 1 || code->information > INFORMATION_GROUPS * code->z) return -1;
  if (code->iterations < 1) return -1;
  code->rows = (int)rows, code->groups = INFORMATION_GROUPS + code->rows, code->edges = 0;
  for (int r = 0; r < code->rows; r++) {
    code->degree[r] = degrees[r];
    if (degrees[r] < 2 || degrees[r] > MOST_DEGREE || degrees[r] > (int)count - code->edges) return -1;
    for (int i = 0; i < degrees[r]; i++, code->edges++) {
      const int column = edges[2 * code->edges], shift = edges[2 * code->edges + 1];
      if (column < 0 || column >= code->groups || shift < 0 || shift >= code->z) return -1;
      for (int other = 1; other <= i; other++)
        if (code->column[code->edges - other] == column) return -1;
      code->column[code->edges] = column, code->shift[code->edges] = shift;
    }
  }
  const int parity = code->sent - sent_before_fillers(code);
  return code->edges == count && code->sent > 0 && parity >= 0 && parity <= code->rows * code->z ? 0 : -1;
}

static PyObject *decode_blocks(PyObject *module, PyObject *args) {
  PyObject *py_degrees, *py_edges, *py_llrs, *py_information, *py_sent, *py_taken;
  buffers opened = {.count = 0}, *const all = &opened;
  ldpc code;
  (void)module;
  if (!PyArg_ParseTuple(args, "(OOiii)ifffOOOO:decode_blocks", &py_degrees, &py_edges, &code.z, &code.information, &code.sent, &code.iterations, &code.offset, &code.most,
                        &code.known, &py_llrs, &py_information, &py_sent, &py_taken))
    return NULL;
  const int32_t *degrees = INTS(py_degrees, "degrees", -1, 0);
  if (!degrees) return ended(all, NULL);
  const Py_ssize_t rows = taken_elements(all);
  const int32_t *edges = INTS(py_edges, "edges", -1, 0);
  if (!edges) return ended(all, NULL);
  const Py_ssize_t numbers = taken_elements(all);
  if (numbers % 2 || take_graph(&code, degrees, rows, edges, numbers / 2) < 0) {
    PyErr_SetString(PyExc_ValueError, "code: got another graph, expected rows of base graph 1 and bits that fit it");
    return ended(all, NULL);
  }
  int32_t *taken = INTS(py_taken, "iterations", -1, 1);
  if (!taken) return ended(all, NULL);
  const Py_ssize_t blocks = taken_elements(all);
  const float *llrs = FLOATS(py_llrs, "LLRs", blocks * code.sent, 0);
  uint8_t *information = llrs ? BYTES(py_information, "information", blocks * code.information, 1) : NULL;
  uint8_t *sent = information ? BYTES(py_sent, "sent", blocks * code.sent, 1) : NULL;
  if (!sent) return ended(all, NULL);
  scratch room = {.room = NULL};
  int has_room;
  Py_BEGIN_ALLOW_THREADS;
  has_room = take_room(&room, &code);
  for (Py_ssize_t b = 0; has_room && b < blocks; b++)
    taken[b] = decode_block(&room, &code, llrs + b * code.sent, information + b * code.information, sent + b * code.sent);
  free_room(&room);
  Py_END_ALLOW_THREADS;
  if (!has_room) return ended(all, PyErr_NoMemory());
  release(all);
  Py_RETURN_NONE;
}

/* The search among a number of uneven levels; among none where they are even. */
static int take_search(buffers *all, search *s, PyObject *borders, PyObject *starts, int levels) {
  s->levels = levels;
  if (s->most < 0 || s->most > MOST_LEVELS) {
    PyErr_SetString(PyExc_ValueError, "levels within a step: expected 0 to 256");
    return -1;
  }
  s->borders = DOUBLES(borders, "borders", levels);
  s->starts = s->borders ? LONGS(starts, "starts", levels ? STEPS + 1 : 0) : NULL;
  if (!s->starts) return -1;
  for (int i = 0; levels && i <= STEPS; i++)
    if (s->starts[i] < 0 || s->starts[i] >= levels) {
      PyErr_SetString(PyExc_ValueError, "starts: expected places");
      return -1;
    }
  return 0;
}

static int take_neighbours(buffers *all, PyObject *from, const levels_table *t, neighbours *n) {
  PyObject *cosine, *sine, *coset;
  const int rows = t->even ? 1 : t->levels;
  int fine = 0;
  if (PyArg_ParseTuple(from, "iOOO", &n->width, &cosine, &sine, &coset)) {
    if (n->width < 2 || n->width > t->levels || n->width & (n->width - 1)) {
      PyErr_SetString(PyExc_ValueError, "neighbours: expected a power of two, at most all levels");
    } else {
      fine = (n->cosine = DOUBLES(cosine, "cosines", rows * n->width)) && (n->sine = DOUBLES(sine, "sines", rows * n->width)) &&
             (n->coset = BYTES(coset, "cosets", t->turn >= 0 ? 0 : t->levels * n->width, 0));
    }
  }
  return fine ? 0 : -1;
}

static PyObject *llrs_of(PyObject *module, PyObject *args) {
  PyObject *py_phase, *py_concentration, *py_sine, *py_cosine, *py_circle, *py_borders, *py_starts, *py_limit, *py_near, *py_all, *py_out;
  buffers opened = {.count = 0}, *const all = &opened;
  levels_table t;
  float most;
  (void)module;
  if (!PyArg_ParseTuple(args, "OO(iipiOO(OdOOi)OO!O!)fO:llrs", &py_phase, &py_concentration, &t.levels, &t.bits, &t.even, &t.turn, &py_sine, &py_cosine, &py_circle,
                        &t.places.first, &py_borders, &py_starts, &t.places.most, &py_limit, &PyTuple_Type, &py_near, &PyTuple_Type, &py_all, &most, &py_out))
    return NULL;
  if (t.levels < 2 || t.levels > MOST_LEVELS || t.levels & (t.levels - 1) || t.bits < 1 || t.bits > MOST_BITS || 1 << t.bits > t.levels || t.turn < -1 ||
      t.turn >= t.levels || (t.even && t.turn)) {
    PyErr_SetString(PyExc_ValueError, "levels: expected a power of two, at most 256, and label bits that they have");
    return NULL;
  }
  t.cosets = 1 << t.bits;
  t.step = TURN / t.levels;
  const double *phase = DOUBLES(py_phase, "phase", -1);
  if (!phase) return ended(all, NULL);
  const Py_ssize_t count = taken_elements(all);
  const double *concentration = DOUBLES(py_concentration, "concentration", count);
  if (!concentration || !(t.sine = DOUBLES(py_sine, "sine", -1))) return ended(all, NULL);
  t.terms = (int)taken_elements(all);
  const int rows = t.even ? 1 : t.levels, uneven = t.even ? 0 : t.levels;
  if (t.terms < 1 || t.terms > MOST_TERMS) {
    PyErr_SetString(PyExc_ValueError, "sine: expected 1 to 20 coefficients");
    return ended(all, NULL);
  }
  if (!(t.cosine = DOUBLES(py_cosine, "cosine", t.terms)) || !(t.circle = DOUBLES(py_circle, "circle", uneven)) || take_search(all, &t.places, py_borders, py_starts, uneven) < 0 ||
      !(t.limit = DOUBLES(py_limit, "limit", rows)) || take_neighbours(all, py_near, &t, &t.near) < 0 ||
      take_neighbours(all, py_all, &t, &t.all) < 0)
    return ended(all, NULL);
  float *out = FLOATS(py_out, "LLRs", count * t.bits, 1);
  if (!out) return ended(all, NULL);
  int bounded;
  Py_BEGIN_ALLOW_THREADS;
  bounded = is_bounded(count, phase, MOST_PHASE);
  for (Py_ssize_t start = 0; bounded && start < count; start += TILE)
    used->ratios(&t, (int)(count - start < TILE ? count - start : TILE), phase + start, concentration + start, most, out + start * t.bits);
  Py_END_ALLOW_THREADS;
  if (!bounded) {
    PyErr_SetString(PyExc_ValueError, "phase: expected at most 1e6 radians");
    return ended(all, NULL);
  }
  release(all);
  Py_RETURN_NONE;
}

static PyObject *lack_of_information(PyObject *module, PyObject *args) {
  PyObject *py_llrs, *py_bits;
  buffers opened = {.count = 0}, *const all = &opened;
  int64_t sum;
  (void)module;
  if (!PyArg_ParseTuple(args, "OO:lack_of_information", &py_llrs, &py_bits)) return NULL;
  const float *llrs = FLOATS(py_llrs, "LLRs", -1, 0);
  if (!llrs) return ended(all, NULL);
  const Py_ssize_t count = taken_elements(all);
  const uint8_t *bits = NULL;
  if (py_bits != Py_None && !(bits = BYTES(py_bits, "bits", count, 0))) return ended(all, NULL);
  Py_BEGIN_ALLOW_THREADS;
  sum = bits ? used->lack_of_truth(count, llrs, bits) : used->lack_as_claimed(count, llrs);
  Py_END_ALLOW_THREADS;
  return ended(all, PyLong_FromLongLong(sum));
}

/* Searches of the cosets of uneven levels: of each one border, borders, starts; then the most in a step, orders. */
static int take_coset_searches(buffers *all, PyObject *from, int bits, int level_bits, coset_searches *found) {
  PyObject *py_first, *py_borders, *py_starts, *py_order;
  search one;
  const int cosets = 1 << bits, levels = 1 << (level_bits - bits);
  if (!PyArg_ParseTuple(from, "OOOiO", &py_first, &py_borders, &py_starts, &one.most, &py_order)) return -1;
  const double *first = DOUBLES(py_first, "first borders", cosets), *borders = first ? DOUBLES(py_borders, "borders", cosets * levels) : NULL;
  const int64_t *starts = borders ? LONGS(py_starts, "starts", cosets * (STEPS + 1)) : NULL;
  found->order = starts ? BYTES(py_order, "order", cosets * levels, 0) : NULL;
  if (!found->order) return -1;
  int wrong = one.most < 0 || one.most > MOST_LEVELS;
  for (int i = 0; i < cosets * (STEPS + 1); i++) wrong |= starts[i] < 0 || starts[i] >= levels;
  if (wrong) {
    PyErr_SetString(PyExc_ValueError, "starts: expected places");
    return -1;
  }
  for (int c = 0; c < cosets; c++) {
    one.levels = levels, one.first = first[c], one.borders = borders + c * levels, one.starts = starts + c * (STEPS + 1);
    found->of[c] = one;
  }
  return 0;
}

static PyObject *upper_bits(PyObject *module, PyObject *args) {
  PyObject *py_phase, *py_label, *py_searches, *py_out;
  buffers opened = {.count = 0}, *const all = &opened;
  int bits, level_bits, bounded;
  coset_searches searches;
  (void)module;
  if (!PyArg_ParseTuple(args, "OOiiOO:upper_bits", &py_phase, &py_label, &bits, &level_bits, &py_searches, &py_out)) return NULL;
  if (bits < 1 || level_bits < bits || level_bits > MOST_BITS) {
    PyErr_SetString(PyExc_ValueError, "bits: expected 1 to 8, and label bits among them");
    return NULL;
  }
  const int uneven = py_searches != Py_None;
  if (uneven && (!PyTuple_Check(py_searches) || take_coset_searches(all, py_searches, bits, level_bits, &searches) < 0)) {
    if (!PyErr_Occurred()) PyErr_SetString(PyExc_TypeError, "searches: expected a tuple or None");
    return ended(all, NULL);
  }
  const double *phase = DOUBLES(py_phase, "phase", -1);
  if (!phase) return ended(all, NULL);
  const Py_ssize_t count = taken_elements(all);
  const uint8_t *label = BYTES(py_label, "label", count * bits, 0);
  uint8_t *out = label ? BYTES(py_out, "numbers", count * (level_bits - bits), 1) : NULL;
  if (!out) return ended(all, NULL);
  Py_BEGIN_ALLOW_THREADS;
  bounded = is_bounded(count, phase, MOST_PHASE);
  if (bounded) upper_numbers(count, phase, label, bits, level_bits, uneven ? &searches : NULL, out);
  Py_END_ALLOW_THREADS;
  return ended(all, PyBool_FromLong(bounded));
}

/* Whether there is a posterior: 0 where all numbers are, 1 where some are too large for the functions here, 2 where not. */
static PyObject *look(PyObject *module, PyObject *args) {
  PyObject *py_phase, *py_concentration;
  buffers opened = {.count = 0}, *const all = &opened;
  double most;
  int large = 0, wrong = 0;
  (void)module;
  if (!PyArg_ParseTuple(args, "OOd:look", &py_phase, &py_concentration, &most)) return NULL;
  const double *phase = DOUBLES(py_phase, "phase", -1);
  const Py_ssize_t count = phase ? taken_elements(all) : 0;
  const double *concentration = phase ? DOUBLES(py_concentration, "concentration", count) : NULL;
  if (!concentration) return ended(all, NULL);
  Py_BEGIN_ALLOW_THREADS;
  for (Py_ssize_t i = 0; i < count; i++) {
    large |= !(fabs(phase[i]) <= MOST_PHASE && concentration[i] <= most);
    wrong |= !(fabs(phase[i]) <= DBL_MAX && concentration[i] >= 0 && concentration[i] <= DBL_MAX);
  }
  Py_END_ALLOW_THREADS;
  return ended(all, PyLong_FromLong(wrong ? 2 : large));
}

static PyObject *gather(PyObject *module, PyObject *args) {
  PyObject *py_values, *py_order, *py_out;
  buffers opened = {.count = 0}, *const all = &opened;
  int wrong = 0;
  (void)module;
  if (!PyArg_ParseTuple(args, "OOO:gather", &py_values, &py_order, &py_out)) return NULL;
  const float *values = FLOATS(py_values, "values", -1, 0);
  if (!values) return ended(all, NULL);
  const Py_ssize_t most = taken_elements(all);
  const int32_t *order = INTS(py_order, "order", -1, 0);
  if (!order) return ended(all, NULL);
  const Py_ssize_t count = taken_elements(all);
  float *out = FLOATS(py_out, "gathered", count, 1);
  if (!out) return ended(all, NULL);
  Py_BEGIN_ALLOW_THREADS;
  for (Py_ssize_t i = 0; i < count; i++) {
    const int32_t from = order[i];
    if (from < 0 || from >= most)
      wrong = 1;
    else
      out[i] = values[from];
  }
  Py_END_ALLOW_THREADS;
  if (wrong) {
    PyErr_SetString(PyExc_ValueError, "order: expected numbers of values");
    return ended(all, NULL);
  }
  release(all);
  Py_RETURN_NONE;
}

static PyObject *scatter(PyObject *module, PyObject *args) {
  PyObject *py_bits, *py_order, *py_out;
  buffers opened = {.count = 0}, *const all = &opened;
  int wrong = 0;
  (void)module;
  if (!PyArg_ParseTuple(args, "OOO:scatter", &py_bits, &py_order, &py_out)) return NULL;
  const uint8_t *bits = BYTES(py_bits, "bits", -1, 0);
  if (!bits) return ended(all, NULL);
  const Py_ssize_t count = taken_elements(all);
  const int32_t *order = INTS(py_order, "order", count, 0);
  uint8_t *out = order ? BYTES(py_out, "scattered", -1, 1) : NULL;
  if (!out) return ended(all, NULL);
  const Py_ssize_t most = taken_elements(all);
  Py_BEGIN_ALLOW_THREADS;
  for (Py_ssize_t i = 0; i < count; i++) {
    const int32_t to = order[i];
    if (to < 0 || to >= most)
      wrong = 1;
    else
      out[to] = bits[i];
  }
  Py_END_ALLOW_THREADS;
  if (wrong) {
    PyErr_SetString(PyExc_ValueError, "order: expected numbers of places");
    return ended(all, NULL);
  }
  release(all);
  Py_RETURN_NONE;
}

static PyObject *variants_of(PyObject *module, PyObject *args) {
  const int count = variants();
  PyObject *names = PyTuple_New(count);
  (void)module, (void)args;
  for (int i = 0; names && i < count; i++) {
    PyObject *name = PyUnicode_FromString(NAMES[i]);
    if (!name || PyTuple_SetItem(names, i, name) < 0) {
      Py_DECREF(names);
      return NULL;
    }
  }
  return names;
}

static PyObject *use(PyObject *module, PyObject *args) {
  int number;
  (void)module;
  if (!PyArg_ParseTuple(args, "i:use", &number)) return NULL;
  if (number < 0 || number >= variants()) {
    PyErr_SetString(PyExc_ValueError, "variant: expected one that this processor has");
    return NULL;
  }
  used = VARIANTS[number];
  Py_RETURN_NONE;
}

static int begin(PyObject *module) {
  (void)module;
  used = VARIANTS[variants() - 1];
  return 0;
}

static PyMethodDef methods[] = {
    {"decode_blocks", decode_blocks, METH_VARARGS, "Decode LDPC blocks."},
    {"llrs", llrs_of, METH_VARARGS, "Log-likelihood ratios of label bits."},
    {"lack_of_information", lack_of_information, METH_VARARGS, "What bits lack of full information, nats in units of 2^-24."},
    {"upper_bits", upper_bits, METH_VARARGS, "Numbers within cosets of even levels, as bits."},
    {"look", look, METH_VARARGS, "Whether phases and concentrations are a posterior."},
    {"gather", gather, METH_VARARGS, "Take values in an order."},
    {"scatter", scatter, METH_VARARGS, "Put bits in an order."},
    {"variants", variants_of, METH_NOARGS, "Sets of instructions that there are, the best last."},
    {"use", use, METH_VARARGS, "Use one of the variants, by its number."},
    {NULL, NULL, 0, NULL},
};

static PyModuleDef_Slot slots[] = {{Py_mod_exec, (void *)begin}, {0, NULL}};

static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, "page_code", "The page code's arithmetic, compiled.", 0, methods, slots, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit_page_code(void) { return PyModuleDef_Init(&definition); }
