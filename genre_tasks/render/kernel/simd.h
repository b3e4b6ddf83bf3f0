// Sixteen float lanes: the pixels of a block, the blocks of a tile, or sixteen Gaussians. Compiler vector extensions, and
// intrinsics where they fall short, in vectors of the machine's own width: a 64-byte vector type compiled for AVX2 is five
// times slower than two 32-byte ones.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#include "../../compiled/vectors.h"

#define INLINE static inline __attribute__((always_inline))
#define INLINE_MEMBER __attribute__((always_inline)) inline

constexpr int LANES = 16, WIDTH = VECTOR_BYTES / 4, VECTORS = LANES / WIDTH;
typedef float NativeF __attribute__((vector_size(VECTOR_BYTES)));
typedef int NativeI __attribute__((vector_size(VECTOR_BYTES)));

struct Lanes {
  NativeF v[VECTORS];
  float operator[](int i) const { return reinterpret_cast<const float*>(v)[i]; }
  float& operator[](int i) { return reinterpret_cast<float*>(v)[i]; }
};
#if VECTOR_BYTES == 64
struct Mask {
  __mmask16 k;
};
#else
struct Mask {
  NativeI v[VECTORS];
};
#endif

#define EACH for (int k = 0; k < VECTORS; k++)
#define BINARY(op)                                                                                        \
  INLINE Lanes operator op(const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = a.v[k] op b.v[k]; return r; } \
  INLINE Lanes operator op(const Lanes& a, float b) { Lanes r; EACH r.v[k] = a.v[k] op b; return r; }      \
  INLINE Lanes operator op(float a, const Lanes& b) { Lanes r; EACH r.v[k] = a op b.v[k]; return r; }
BINARY(+) BINARY(-) BINARY(*) BINARY(/)
INLINE Lanes& operator+=(Lanes& a, const Lanes& b) { return a = a + b; }
INLINE Lanes operator-(const Lanes& a) { Lanes r; EACH r.v[k] = -a.v[k]; return r; }
INLINE Lanes broadcast(float x) { Lanes r; EACH r.v[k] = NativeF{} + x; return r; }
INLINE Lanes max(const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = a.v[k] > b.v[k] ? a.v[k] : b.v[k]; return r; }
INLINE Lanes min(const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = a.v[k] < b.v[k] ? a.v[k] : b.v[k]; return r; }
INLINE Lanes clamp(const Lanes& x, const Lanes& low, const Lanes& high) { return min(max(x, low), high); }
INLINE Lanes minus_abs(const Lanes& a) { Lanes r; EACH r.v[k] = (NativeF)((NativeI)a.v[k] | (int)0x80000000); return r; }

INLINE Lanes abs(const Lanes& a) { Lanes r; EACH r.v[k] = (NativeF)((NativeI)a.v[k] & 0x7fffffff); return r; }
INLINE Lanes sqrt(const Lanes& a) {
  Lanes r;
#if VECTOR_BYTES == 64
  r.v[0] = (NativeF)_mm512_sqrt_ps((__m512)a.v[0]);
#elif VECTOR_BYTES == 32
  EACH r.v[k] = (NativeF)_mm256_sqrt_ps((__m256)a.v[k]);
#elif defined(__SSE2__) && VECTOR_BYTES == 16
  EACH r.v[k] = (NativeF)_mm_sqrt_ps((__m128)a.v[k]);
#else
  for (int i = 0; i < LANES; i++) r[i] = std::sqrt(a[i]);
#endif
  return r;
}

// keep: a where m, else 0, also where a is NaN. is_finite looks at the bits: it stays right under any floating-point flags.
#if VECTOR_BYTES == 64
#define COMPARE(op, code) \
  INLINE Mask operator op(const Lanes& a, const Lanes& b) { return {_mm512_cmp_ps_mask((__m512)a.v[0], (__m512)b.v[0], code)}; }
COMPARE(<, _CMP_LT_OQ) COMPARE(>, _CMP_GT_OQ) COMPARE(>=, _CMP_GE_OQ) COMPARE(<=, _CMP_LE_OQ)
INLINE Mask operator&(Mask a, Mask b) { return {(__mmask16)(a.k & b.k)}; }
INLINE Mask operator|(Mask a, Mask b) { return {(__mmask16)(a.k | b.k)}; }
INLINE Mask operator~(Mask a) { return {(__mmask16)~a.k}; }
INLINE Lanes select(Mask m, const Lanes& a, const Lanes& b) {
  return {{(NativeF)_mm512_mask_mov_ps((__m512)b.v[0], m.k, (__m512)a.v[0])}};
}
INLINE Lanes keep(const Lanes& a, Mask m) { return {{(NativeF)_mm512_maskz_mov_ps(m.k, (__m512)a.v[0])}}; }
INLINE Mask is_finite(const Lanes& a) {
  const __m512i exponent = _mm512_set1_epi32(0x7f800000);
  return {_mm512_cmpneq_epi32_mask(_mm512_and_si512((__m512i)a.v[0], exponent), exponent)};
}
INLINE uint32_t bits(Mask m) { return m.k; }
#else
#define COMPARE(op) \
  INLINE Mask operator op(const Lanes& a, const Lanes& b) { Mask r; EACH r.v[k] = a.v[k] op b.v[k]; return r; }
COMPARE(<) COMPARE(>) COMPARE(>=) COMPARE(<=)
INLINE Mask operator&(const Mask& a, const Mask& b) { Mask r; EACH r.v[k] = a.v[k] & b.v[k]; return r; }
INLINE Mask operator|(const Mask& a, const Mask& b) { Mask r; EACH r.v[k] = a.v[k] | b.v[k]; return r; }
INLINE Mask operator~(const Mask& a) { Mask r; EACH r.v[k] = ~a.v[k]; return r; }
INLINE Lanes select(const Mask& m, const Lanes& a, const Lanes& b) {
  Lanes r;
  EACH r.v[k] = m.v[k] ? a.v[k] : b.v[k];
  return r;
}
INLINE Lanes keep(const Lanes& a, const Mask& m) {
  Lanes r;
  EACH r.v[k] = (NativeF)((NativeI)a.v[k] & m.v[k]);
  return r;
}
INLINE Mask is_finite(const Lanes& a) { Mask r; EACH r.v[k] = ((NativeI)a.v[k] & 0x7f800000) != 0x7f800000; return r; }
INLINE uint32_t bits(const Mask& m) {
#if VECTOR_BYTES == 32
  return _mm256_movemask_ps((__m256)m.v[0]) | _mm256_movemask_ps((__m256)m.v[1]) << 8;
#else
  uint32_t r = 0;
#if defined(__SSE2__)
  EACH r |= _mm_movemask_ps((__m128)m.v[k]) << 4 * k;
#else
  for (int i = 0; i < LANES; i++) r |= (uint32_t)(reinterpret_cast<const int*>(m.v)[i] & 1) << i;
#endif
  return r;
#endif
}
#endif
INLINE Mask operator<(const Lanes& a, float b) { return a < broadcast(b); }
INLINE Mask operator>(const Lanes& a, float b) { return a > broadcast(b); }
INLINE Mask operator>=(const Lanes& a, float b) { return a >= broadcast(b); }
INLINE Mask operator<=(const Lanes& a, float b) { return a <= broadcast(b); }
INLINE bool any(const Mask& m) { return bits(m) != 0; }

// Writes base + i for each bit i that is set, and returns how many; may write up to LANES entries.
INLINE int list_bits(uint32_t set, uint32_t base, uint32_t* out) {
#if VECTOR_BYTES == 64
  const __m512i lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
  _mm512_storeu_si512(out, _mm512_add_epi32(_mm512_maskz_compress_epi32((__mmask16)set, lane), _mm512_set1_epi32(base)));
#else
  for (uint32_t left = set; left; left &= left - 1) *out++ = base + __builtin_ctz(left);
#endif
  return __builtin_popcount(set);
}

constexpr float EXP2_0 = 1.000000072f, EXP2_1 = 6.931469671e-1f, EXP2_2 = 2.402211972e-1f, EXP2_3 = 5.550713273e-2f,
                EXP2_4 = 9.675541334e-3f, EXP2_5 = 1.327647199e-3f;

// 2^p for p in [-126, 127]: exponent by integer addition, fraction in [-1/2, 1/2] by a minimax polynomial with a relative error
// of 7.5e-8. Below -126 it gives 2^-126, far under the alpha cut.
INLINE Lanes exp2(const Lanes& x) {
  Lanes r;
  EACH {
    NativeF p = x.v[k], low = NativeF{} - 126.f;
    p = p > low ? p : low;
    NativeF m = p + 12582912.f, f = p - (m - 12582912.f);  // 1.5 * 2^23: rounds to the nearest integer
    NativeI n = ((NativeI)m) << 23;
    NativeF q = NativeF{} + EXP2_5;
    q = q * f + EXP2_4;
    q = q * f + EXP2_3;
    q = q * f + EXP2_2;
    q = q * f + EXP2_1;
    q = q * f + EXP2_0;
    r.v[k] = (NativeF)((NativeI)q + n);
  }
  return r;
}

// 1 / x for x in [1 - ALPHA_MAX, 1], relative error below 1e-7: the machine's estimate and a Newton step.
INLINE Lanes reciprocal(const Lanes& x) {
  Lanes r;
#if VECTOR_BYTES == 64
  r.v[0] = (NativeF)_mm512_rcp14_ps((__m512)x.v[0]);
#elif VECTOR_BYTES == 32
  EACH r.v[k] = (NativeF)_mm256_rcp_ps((__m256)x.v[k]);
#elif defined(__SSE2__) && VECTOR_BYTES == 16
  EACH r.v[k] = (NativeF)_mm_rcp_ps((__m128)x.v[k]);
#else
  return 1.f / x;
#endif
  return r * (2.f - x * r);
}

// Non-temporal: pair gradients are read much later, and would only push the tile's data out of the cache.
INLINE void stream(Lanes* at, const Lanes& x) {
#if VECTOR_BYTES == 64
  _mm512_stream_ps(reinterpret_cast<float*>(at), (__m512)x.v[0]);
#elif VECTOR_BYTES == 32
  EACH _mm256_stream_ps(reinterpret_cast<float*>(at) + 8 * k, (__m256)x.v[k]);
#elif defined(__SSE2__) && VECTOR_BYTES == 16
  EACH _mm_stream_ps(reinterpret_cast<float*>(at) + 4 * k, (__m128)x.v[k]);
#else
  *at = x;
#endif
}

// Non-temporal stores are not ordered with what follows, not even for the thread that joins this one.
INLINE void stream_end() {
#if defined(__SSE2__)
  _mm_sfence();
#endif
}

template <int H, size_t... I>
INLINE NativeF fold_native(NativeF a, NativeF b, std::index_sequence<I...>) {
  constexpr auto low = [](int i) { int o = i % (2 * H), s = i - o; return o < H ? s + o : WIDTH + s + o - H; };
#if defined(__clang__) || __GNUC__ >= 12
  return __builtin_shufflevector(a, b, low(I)...) + __builtin_shufflevector(a, b, (low(I) + H)...);
#else
  return __builtin_shuffle(a, b, NativeI{low(I)...}) + __builtin_shuffle(a, b, NativeI{(low(I) + H)...});
#endif
}

// One level of a transposing sum: halves at distance H of `a` and of `b` are added and interleaved. Four levels turn the
// sums of sixteen lane vectors into one vector, at a third of the cost of sixteen horizontal sums.
template <int H>
INLINE Lanes fold(const Lanes& a, const Lanes& b) {
  Lanes r;
  if constexpr (H >= WIDTH) {
    constexpr int q = H / WIDTH;
    for (int k = 0; k < VECTORS; k++) {
      int block = k / (2 * q), o = k % (2 * q);
      r.v[k] = o < q ? a.v[block * 2 * q + o] + a.v[block * 2 * q + o + q]
                     : b.v[block * 2 * q + o - q] + b.v[block * 2 * q + o];
    }
  } else {
    EACH r.v[k] = fold_native<H>(a.v[k], b.v[k], std::make_index_sequence<WIDTH>{});
  }
  return r;
}

constexpr int SUMS = 10, ALL_SUMS = 15;
INLINE Lanes sums(const Lanes (&x)[SUMS]) {
  Lanes zero{}, a0 = fold<8>(x[0], x[1]), a1 = fold<8>(x[2], x[3]), a2 = fold<8>(x[4], x[5]), a3 = fold<8>(x[6], x[7]),
        a4 = fold<8>(x[8], x[9]);
  Lanes b0 = fold<4>(a0, a1), b1 = fold<4>(a2, a3), b2 = fold<4>(a4, zero);
  return fold<1>(fold<2>(b0, b1), fold<2>(b2, zero));
}
// Five more of them; the first ten come to lie in the same lanes, as the same numbers.
INLINE Lanes sums(const Lanes (&x)[ALL_SUMS]) {
  Lanes zero{}, a0 = fold<8>(x[0], x[1]), a1 = fold<8>(x[2], x[3]), a2 = fold<8>(x[4], x[5]), a3 = fold<8>(x[6], x[7]),
        a4 = fold<8>(x[8], x[9]), a5 = fold<8>(x[10], x[11]), a6 = fold<8>(x[12], x[13]), a7 = fold<8>(x[14], zero);
  Lanes b0 = fold<4>(a0, a1), b1 = fold<4>(a2, a3), b2 = fold<4>(a4, a5), b3 = fold<4>(a6, a7);
  return fold<1>(fold<2>(b0, b1), fold<2>(b2, b3));
}
