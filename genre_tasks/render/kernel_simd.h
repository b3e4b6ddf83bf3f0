// Sixteen float lanes: one pixel row of a tile. Compiler vector extensions instead of intrinsics, in vectors of the
// machine's own width: a 64-byte vector type compiled for AVX2 is five times slower than two 32-byte ones.
#pragma once
#include <cstddef>
#include <utility>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define VECTOR_BYTES 64
#elif defined(__AVX__)
#define VECTOR_BYTES 32
#else
#define VECTOR_BYTES 16
#endif
#define INLINE static inline __attribute__((always_inline))

constexpr int LANES = 16, WIDTH = VECTOR_BYTES / 4, VECTORS = LANES / WIDTH;
typedef float NativeF __attribute__((vector_size(VECTOR_BYTES)));
typedef int NativeI __attribute__((vector_size(VECTOR_BYTES)));

struct Lanes {
  NativeF v[VECTORS];
  float operator[](int i) const { return reinterpret_cast<const float*>(v)[i]; }
  float& operator[](int i) { return reinterpret_cast<float*>(v)[i]; }
};
struct Mask {
  NativeI v[VECTORS];
};

#define EACH for (int k = 0; k < VECTORS; k++)
#define BINARY(op)                                                                                        \
  INLINE Lanes operator op(const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = a.v[k] op b.v[k]; return r; } \
  INLINE Lanes operator op(const Lanes& a, float b) { Lanes r; EACH r.v[k] = a.v[k] op b; return r; }      \
  INLINE Lanes operator op(float a, const Lanes& b) { Lanes r; EACH r.v[k] = a op b.v[k]; return r; }
BINARY(+) BINARY(-) BINARY(*) BINARY(/)
#define COMPARE(op) \
  INLINE Mask operator op(const Lanes& a, float b) { Mask r; NativeF t = NativeF{} + b; EACH r.v[k] = a.v[k] op t; return r; }
COMPARE(<) COMPARE(>) COMPARE(>=)

INLINE Lanes& operator+=(Lanes& a, const Lanes& b) { return a = a + b; }
INLINE Lanes operator-(const Lanes& a) { Lanes r; EACH r.v[k] = -a.v[k]; return r; }
INLINE Mask operator&(const Mask& a, const Mask& b) { Mask r; EACH r.v[k] = a.v[k] & b.v[k]; return r; }
INLINE Mask operator~(const Mask& a) { Mask r; EACH r.v[k] = ~a.v[k]; return r; }
INLINE Lanes select(const Mask& m, const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = m.v[k] ? a.v[k] : b.v[k]; return r; }
INLINE Lanes broadcast(float x) { Lanes r; EACH r.v[k] = NativeF{} + x; return r; }
INLINE Lanes max(const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = a.v[k] > b.v[k] ? a.v[k] : b.v[k]; return r; }
INLINE Lanes min(const Lanes& a, const Lanes& b) { Lanes r; EACH r.v[k] = a.v[k] < b.v[k] ? a.v[k] : b.v[k]; return r; }
// Bit masks rather than products: they also stop a NaN.
INLINE Lanes keep(const Lanes& a, const Mask& m) { Lanes r; EACH r.v[k] = (NativeF)((NativeI)a.v[k] & m.v[k]); return r; }
INLINE Lanes minus_abs(const Lanes& a) { Lanes r; EACH r.v[k] = (NativeF)((NativeI)a.v[k] | (int)0x80000000); return r; }

INLINE bool any(const Mask& m) {
  NativeI o = m.v[0];
  for (int k = 1; k < VECTORS; k++) o |= m.v[k];
#if defined(__AVX512DQ__) && VECTOR_BYTES == 64
  return _mm512_movepi32_mask((__m512i)o) != 0;
#elif defined(__AVX__) && VECTOR_BYTES == 32
  return _mm256_movemask_ps((__m256)o) != 0;
#elif defined(__SSE2__) && VECTOR_BYTES == 16
  return _mm_movemask_ps((__m128)o) != 0;
#else
  int r = 0;
  for (int i = 0; i < WIDTH; i++) r |= o[i];
  return r != 0;
#endif
}

constexpr float EXP2_0 = 1.000000072f, EXP2_1 = 6.931469671e-1f, EXP2_2 = 2.402211972e-1f, EXP2_3 = 5.550713273e-2f,
                EXP2_4 = 9.675541334e-3f, EXP2_5 = 1.327647199e-3f;

// 2^p for p in [-126, 127], polynomial's relative error 7.5e-8: exponent by integer addition, fraction in [-1/2, 1/2] by a minimax
// polynomial. Below -126 it gives 2^-126, far under the alpha cut.
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

// Non-temporal: pair gradients are read much later, and would only push the tile's data out of the cache.
INLINE void stream(Lanes* at, const Lanes& x) {
#if defined(__AVX512F__) && VECTOR_BYTES == 64
  _mm512_stream_ps(reinterpret_cast<float*>(at), (__m512)x.v[0]);
#elif defined(__AVX__) && VECTOR_BYTES == 32
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

constexpr int SUMS = 10;
INLINE Lanes sums(const Lanes (&x)[SUMS]) {
  Lanes zero{}, a0 = fold<8>(x[0], x[1]), a1 = fold<8>(x[2], x[3]), a2 = fold<8>(x[4], x[5]), a3 = fold<8>(x[6], x[7]),
        a4 = fold<8>(x[8], x[9]);
  Lanes b0 = fold<4>(a0, a1), b1 = fold<4>(a2, a3), b2 = fold<4>(a4, zero);
  return fold<1>(fold<2>(b0, b1), fold<2>(b2, zero));
}
