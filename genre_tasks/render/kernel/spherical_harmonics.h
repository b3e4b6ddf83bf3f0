// What views see of Gaussians with spherical harmonics, and the way back; scene/harmonics.py is the oracle. Each Gaussian adds
// up its views in their order: every result has the same bits at any number of threads.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "../../compiled/runtime.h"

struct Glossy {
  int64_t count, harmonics;             // N, K
  const float *means, *colors, *waves;  // [N, 3], [N, 3], [N, K, 3], in each Gaussian's own frame
  const int32_t *frame, *slot;          // [N]: whose frame that is, 0 the chunk's; place among the splats of the first log frame
  int64_t views, frames, splats;        // V, frames of an eye, splats of all log frames
  const float* eyes;                    // [V, frames, 3] the camera's centre
  const int64_t* later;                 // [V]: a moving Gaussian's splat is so many places behind its slot
};

// Y[k] of the unit direction, and with GRADIENT its derivatives by x, y and z. Signs and order of 3DGS.
template <bool GRADIENT>
static inline void waves_at(int64_t count, float x, float y, float z, float* Y, float (*D)[3]) {
  auto put = [&](int k, float value, float dx, float dy, float dz) {
    Y[k] = value;
    if (GRADIENT) D[k][0] = dx, D[k][1] = dy, D[k][2] = dz;
  };
  const float c = 0.4886025119029199f;
  put(0, -c * y, 0, -c, 0), put(1, c * z, 0, 0, c), put(2, -c * x, -c, 0, 0);
  if (count <= 3) return;
  const float a = 1.0925484305920792f, b = 0.31539156525252005f, e = 0.5462742152960396f;
  put(3, a * x * y, a * y, a * x, 0), put(4, -a * y * z, 0, -a * z, -a * y);
  put(5, b * (2 * z * z - x * x - y * y), -2 * b * x, -2 * b * y, 4 * b * z);
  put(6, -a * x * z, -a * z, 0, -a * x), put(7, e * (x * x - y * y), 2 * e * x, -2 * e * y, 0);
}

// f(view, splat, direction, 1 / distance, whether the distance is held) for each view.
template <class F>
static inline void each_sight(const Glossy& g, int64_t i, F f) {
  const float* mean = g.means + 3 * i;
  for (int64_t v = 0; v < g.views; v++) {
    const float* eye = g.eyes + 3 * (v * g.frames + g.frame[i]);
    const float x = mean[0] - eye[0], y = mean[1] - eye[1], z = mean[2] - eye[2], square = x * x + y * y + z * z;
    const bool held = !(square >= NEAR_M * NEAR_M);
    const float inverse = 1.f / std::sqrt(held ? NEAR_M * NEAR_M : square);
    const float d[3] = {x * inverse, y * inverse, z * inverse};
    f(v, v * g.splats + g.slot[i] + (g.frame[i] ? g.later[v] : 0), d, inverse, held);
  }
}

constexpr int MOST_WAVES = 8;

static inline bool sound(const Glossy& g, int64_t i) {
  bool finite = true;
  for (int k = 0; k < 3; k++) finite &= std::isfinite(g.means[3 * i + k]);
  for (int64_t k = 0; k < 3 * g.harmonics; k++) finite &= std::isfinite(g.waves[3 * g.harmonics * i + k]);
  return finite;
}

template <class F>
static void each_share(int64_t count, int threads, F f) {
  const int crew = (int)std::max<int64_t>(1, std::min<int64_t>(threads, count / 512));
  parallel(crew, [&](int w) {
    for (int64_t i = count * w / crew; i < count * (w + 1) / crew; i++) f(i);
  });
}

// out [V, splats, 3]; what a view does not show is 0.
static void gloss_forward(const Glossy& g, int threads, float* out) {
  std::fill(out, out + 3 * g.views * g.splats, 0.f);
  each_share(g.count, threads, [&](int64_t i) {
    const float *waves = g.waves + 3 * g.harmonics * i, *own = g.colors + 3 * i;
    const bool fine = sound(g, i);
    each_sight(g, i, [&](int64_t, int64_t splat, const float* d, float, bool) {
      float Y[MOST_WAVES], sum[3] = {own[0], own[1], own[2]};
      waves_at<false>(g.harmonics, d[0], d[1], d[2], Y, nullptr);
      for (int64_t k = 0; k < g.harmonics; k++)
        for (int c = 0; c < 3; c++) sum[c] += Y[k] * waves[3 * k + c];
      for (int c = 0; c < 3; c++) out[3 * splat + c] = !fine ? NAN : sum[c] < 0 ? 0.f : sum[c];
    });
  });
}

// seen [V, splats, 3] is what gloss_forward wrote.
static void gloss_backward(const Glossy& g, int threads, const float* seen, const float* by_seen, float* by_means,
                           float* by_colors, float* by_waves) {
  each_share(g.count, threads, [&](int64_t i) {
    const int64_t K = g.harmonics;
    const float* waves = g.waves + 3 * K * i;
    float *mean = by_means + 3 * i, *own = by_colors + 3 * i, *wave = by_waves + 3 * K * i;
    std::fill(mean, mean + 3, 0.f), std::fill(own, own + 3, 0.f), std::fill(wave, wave + 3 * K, 0.f);
    if (!sound(g, i)) return;
    each_sight(g, i, [&](int64_t, int64_t splat, const float* d, float inverse, bool held) {
      float v[3], Y[MOST_WAVES], D[MOST_WAVES][3], by_d[3] = {};
      for (int c = 0; c < 3; c++) v[c] = seen[3 * splat + c] > 0 ? by_seen[3 * splat + c] : 0.f;
      if (v[0] == 0 && v[1] == 0 && v[2] == 0) return;
      waves_at<true>(K, d[0], d[1], d[2], Y, D);
      for (int c = 0; c < 3; c++) own[c] += v[c];
      for (int64_t k = 0; k < K; k++) {
        float by_Y = 0;
        for (int c = 0; c < 3; c++) wave[3 * k + c] += Y[k] * v[c], by_Y += waves[3 * k + c] * v[c];
        for (int j = 0; j < 3; j++) by_d[j] += by_Y * D[k][j];
      }
      const float along = held ? 0.f : d[0] * by_d[0] + d[1] * by_d[1] + d[2] * by_d[2];
      for (int j = 0; j < 3; j++) mean[j] += (by_d[j] - along * d[j]) * inverse;
    });
  });
}
