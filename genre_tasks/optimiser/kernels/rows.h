// Rows of sixteen floats, functions on them, and dense layers of many rows.
#pragma once
#include <cmath>
#include <cstring>

#include "../../render/kernel/simd.h"

typedef NativeF Unaligned __attribute__((aligned(4)));

INLINE Lanes load(const float* at) { Lanes r; EACH r.v[k] = *reinterpret_cast<const Unaligned*>(at + WIDTH * k); return r; }
INLINE void store(float* at, const Lanes& x) { EACH *reinterpret_cast<Unaligned*>(at + WIDTH * k) = x.v[k]; }

// The attributes of a Gaussian; nothing behind them is touched.
constexpr int ATTRIBUTES = 14;
INLINE Lanes load_attributes(const float* at) {
#if VECTOR_BYTES == 64
  return {{(NativeF)_mm512_maskz_loadu_ps(0x3fff, at)}};
#elif VECTOR_BYTES == 32
  const __m256i six = _mm256_set_epi32(0, 0, -1, -1, -1, -1, -1, -1);
  return {{*reinterpret_cast<const Unaligned*>(at), (NativeF)_mm256_maskload_ps(at + 8, six)}};
#else
  Lanes r{};
  for (int k = 0; k < 3; k++) r.v[k] = *reinterpret_cast<const Unaligned*>(at + WIDTH * k);
  std::memcpy(&r.v[3], at + 12, 8);
  return r;
#endif
}
INLINE void store_attributes(float* at, const Lanes& x) {
#if VECTOR_BYTES == 64
  _mm512_mask_storeu_ps(at, 0x3fff, (__m512)x.v[0]);
#elif VECTOR_BYTES == 32
  const __m256i six = _mm256_set_epi32(0, 0, -1, -1, -1, -1, -1, -1);
  *reinterpret_cast<Unaligned*>(at) = x.v[0];
  _mm256_maskstore_ps(at + 8, six, (__m256)x.v[1]);
#else
  for (int k = 0; k < 3; k++) *reinterpret_cast<Unaligned*>(at + WIDTH * k) = x.v[k];
  std::memcpy(at + 12, &x.v[3], 8);
#endif
}

// As torch's clamp: NaN stays NaN, unlike with clamp() of the header above.
INLINE NativeF bounded(NativeF x, NativeF low, NativeF high) {
  x = x < low ? low : x;
  return x > high ? high : x;
}
INLINE Lanes bounded(const Lanes& x, const Lanes& low, const Lanes& high) {
  Lanes r;
  EACH r.v[k] = bounded(x.v[k], low.v[k], high.v[k]);
  return r;
}
INLINE Lanes bounded(const Lanes& x, float low, float high) { return bounded(x, broadcast(low), broadcast(high)); }

constexpr float LOG2_E = 1.44269504f;
// A minimax polynomial for 2^f on [-1/2, 1/2] that is exactly 1 at 0: a network whose last layer is zero changes nothing.
constexpr float POWER_1 = 6.931470037e-1f, POWER_2 = 2.402224243e-1f, POWER_3 = 5.550733581e-2f, POWER_4 = 9.671512991e-3f,
                POWER_5 = 1.326472848e-3f;

// 2^x, relative error 2e-7, with x clamped to [-125, 125].
INLINE Lanes power_of_2(const Lanes& x) {
  Lanes r, clamped = bounded(x, -125.f, 125.f);
  EACH {
    NativeF m = clamped.v[k] + 12582912.f, f = clamped.v[k] - (m - 12582912.f);  // 1.5 * 2^23: rounds to the nearest integer
    NativeI n = ((NativeI)m) << 23;
    NativeF q = POWER_5 * f + POWER_4;
    q = q * f + POWER_3;
    q = q * f + POWER_2;
    q = q * f + POWER_1;
    q = q * f + 1.f;
    r.v[k] = (NativeF)((NativeI)q + n);
  }
  return r;
}

INLINE Lanes silu(const Lanes& x) { return x * reciprocal(1.f + power_of_2(x * -LOG2_E)); }

// Absolute error 2e-7, exactly 0 at 0.
INLINE Lanes tanh(const Lanes& x) {
  Lanes e = power_of_2(minus_abs(x) * (2 * LOG2_E)), t = (1.f - e) * reciprocal(1.f + e), r;
  EACH r.v[k] = x.v[k] < NativeF{} ? -t.v[k] : t.v[k];
  return r;
}

// log2 of normal positive numbers, absolute error 1e-6.
INLINE Lanes log2(const Lanes& x) {
  Lanes r;
  EACH {
    NativeI i = (NativeI)x.v[k], n = (i - 0x3f3504f3) >> 23;  // the mantissa lies in [sqrt(1/2), sqrt(2))
    NativeF m = (NativeF)(i - (n << 23)), s = (m - 1.f) / (m + 1.f), s2 = s * s;
    NativeF q = s2 * (2 * LOG2_E / 9) + 2 * LOG2_E / 7;
    q = q * s2 + 2 * LOG2_E / 5;
    q = q * s2 + 2 * LOG2_E / 3;
    q = q * s2 + 2 * LOG2_E;
    r.v[k] = q * s + __builtin_convertvector(n, NativeF);
  }
  return r;
}

// As many sums as fit the registers are kept there.
constexpr int TILE_ROWS = VECTOR_BYTES == 64 ? 12 : 6, TILE_VECTORS = 2, TILE_COLUMNS = TILE_VECTORS * WIDTH;

// out[r, :] = start(r)[:] + rows[r, :depth] @ weight [depth, columns] for r < count, and up to TILE_ROWS - 1 rows behind them,
// which must be there. `columns` is a multiple of 2 * LANES.
template <class F>
INLINE void dense(int count, const float* rows, size_t stride, int depth, const float* weight, size_t columns, F start,
                  float* out) {
  for (size_t column = 0; column < columns; column += TILE_COLUMNS)
    for (int first = 0; first < count; first += TILE_ROWS) {
      NativeF sum[TILE_ROWS][TILE_VECTORS];
      for (int r = 0; r < TILE_ROWS; r++)
        for (int v = 0; v < TILE_VECTORS; v++)
          sum[r][v] = *reinterpret_cast<const Unaligned*>(start(first + r) + column + WIDTH * v);
      const float *w = weight + column, *x = rows + first * stride;
      for (int k = 0; k < depth; k++, w += columns, x++) {
        NativeF by[TILE_VECTORS];
        for (int v = 0; v < TILE_VECTORS; v++) by[v] = *reinterpret_cast<const Unaligned*>(w + WIDTH * v);
        for (int r = 0; r < TILE_ROWS; r++)
          for (int v = 0; v < TILE_VECTORS; v++) sum[r][v] += x[r * stride] * by[v];
      }
      for (int r = 0; r < TILE_ROWS; r++)
        for (int v = 0; v < TILE_VECTORS; v++)
          *reinterpret_cast<Unaligned*>(out + (first + r) * columns + column + WIDTH * v) = sum[r][v];
    }
}

INLINE void silu_rows(float* x, size_t n) {
  for (size_t i = 0; i < n; i += LANES) store(x + i, silu(load(x + i)));
}
