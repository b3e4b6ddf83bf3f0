// From Gaussians, sixteen at a time, to their footprints on the image, forward and backward. M = J R_camera R_gaussian S is
// 2x3 and the projected covariance is M M^T: the 3x3 covariance is never formed.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "camera.h"

constexpr float LOG2E = 1.4426950408889634f;
const float LOG2_ALPHA_MIN = std::log2(ALPHA_MIN);

// A footprint: alpha(d) = 2^(log2_opacity - a (dx + k dy)^2 - m dy^2). One cache line.
struct alignas(64) Footprint {
  float x, y, a, k, m, log2_opacity, red, green, blue, z;
  float level;             // of the quadratic form, where alpha falls below the skip; widened: rounding never cuts a pixel off
  float half_y, dy_at_right;  // extent; dy where dx is greatest
  float dy_per_dx;         // where alpha is greatest along a vertical line
  float inv_a, opacity;
};

// One entry of an attribute for the Gaussians `id`, from an array with `stride` entries a Gaussian.
INLINE Lanes gather(const float* entries, int stride, const uint32_t* id) {
  Lanes r;
  for (int i = 0; i < LANES; i++) r[i] = entries[(size_t)stride * id[i]];
  return r;
}

struct GaussianArrays {
  int count;
  const float *means, *scales, *quats, *opacities, *colors;
  const float* velocities;  // m/s in chunk axes; null: nothing moves
};

template <bool ROLLING_SHUTTER>
struct GaussianLanes {
  Lanes mean[3], scale[3], quat[4], velocity[3];  // the last for a rolling shutter only
  INLINE_MEMBER GaussianLanes(const GaussianArrays& in, const uint32_t* id) {
    for (int k = 0; k < 3; k++) mean[k] = gather(in.means + k, 3, id), scale[k] = gather(in.scales + k, 3, id);
    for (int k = 0; k < 4; k++) quat[k] = gather(in.quats + k, 4, id);
    if constexpr (ROLLING_SHUTTER)
      for (int k = 0; k < 3; k++) velocity[k] = in.velocities ? gather(in.velocities + k, 3, id) : Lanes{};
  }
};

INLINE Lanes norm2(const Lanes (&q)[4]) { return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]; }

// Where a camera sees Gaussians from: with a rolling shutter, when their rows are exposed.
template <bool ROLLING_SHUTTER, bool DISTORTION>
using CameraPosition = std::conditional_t<ROLLING_SHUTTER, ExposedPosition<DISTORTION>, PosedPosition>;

template <bool DISTORTION>
struct Projection {
  Lanes px, py, pz, rz, u, v, x, y;  // camera coordinates, 1 / pz, the point of linearisation, and the centre's pixel
  Mask u_limited, v_limited;
  Lanes unsheared[3];          // second row of W
  Lanes W[6], Rq[9], U[6], M[6], c00, c01, c11, q[4], inv_norm;

  INLINE_MEMBER void rotate(const Lanes (&quat)[4]) {
    // The squares of a long quaternion overflow, its direction does not.
    Lanes shrink = select(norm2(quat) > 1e30f, broadcast(1e-20f), broadcast(1.f));
    for (int k = 0; k < 4; k++) q[k] = quat[k] * shrink;
    Lanes inv = 1.f / sqrt(norm2(q));
    inv_norm = inv * shrink;
    for (int k = 0; k < 4; k++) q[k] = q[k] * inv;
    const Lanes &w = q[0], &x = q[1], &y = q[2], &z = q[3];
    Rq[0] = 1.f - 2.f * (y * y + z * z), Rq[1] = 2.f * (x * y - w * z), Rq[2] = 2.f * (x * z + w * y);
    Rq[3] = 2.f * (x * y + w * z), Rq[4] = 1.f - 2.f * (x * x + z * z), Rq[5] = 2.f * (y * z - w * x);
    Rq[6] = 2.f * (x * z - w * y), Rq[7] = 2.f * (y * z + w * x), Rq[8] = 1.f - 2.f * (x * x + y * y);
  }
  template <class Gaussian, class Position>
  INLINE_MEMBER Projection(const Camera& c, const Gaussian& g, const Position& in_camera) {
    px = in_camera.position[0], py = in_camera.position[1], pz = in_camera.position[2], rz = 1.f / pz;
    Lanes ux = px * rz, uy = py * rz;
    u = clamp(ux, broadcast(-c.left), broadcast(c.right)), v = clamp(uy, broadcast(-c.top), broadcast(c.bottom));
    u_limited = (ux > c.right) | (ux < -c.left), v_limited = (uy > c.bottom) | (uy < -c.top);
    if constexpr (DISTORTION) {
      const DistortedPoint distorted_center(c, ux, uy), distorted(c, u, v);
      x = c.fx * distorted_center.x + c.cx, y = c.fy * distorted_center.y + c.cy;
      const Lanes fx = c.fx * rz, fy = c.fy * rz;
      const Lanes J[4] = {fx * distorted.xx, fx * distorted.xy, fy * distorted.xy, fy * distorted.yy};
      for (int k = 0; k < 3; k++)
        for (int row = 0; row < 2; row++)
          W[3 * row + k] = J[2 * row] * (c.R[k] - u * c.R[6 + k]) + J[2 * row + 1] * (c.R[3 + k] - v * c.R[6 + k]);
    } else {
      x = c.fx * px * rz + c.cx, y = c.fy * py * rz + c.cy;
      Lanes j00 = c.fx * rz, j02 = -j00 * u, j11 = c.fy * rz, j12 = -j11 * v;
      for (int k = 0; k < 3; k++) W[k] = j00 * c.R[k] + j02 * c.R[6 + k], W[3 + k] = j11 * c.R[3 + k] + j12 * c.R[6 + k];
    }
    for (int k = 0; k < 3; k++) unsheared[k] = W[3 + k];
    in_camera.shear(W);
    rotate(g.quat);
    for (int k = 0; k < 3; k++) {
      U[k] = W[0] * Rq[k] + W[1] * Rq[3 + k] + W[2] * Rq[6 + k];
      U[3 + k] = W[3] * Rq[k] + W[4] * Rq[3 + k] + W[5] * Rq[6 + k];
      M[k] = U[k] * g.scale[k], M[3 + k] = U[3 + k] * g.scale[k];
    }
    c00 = M[0] * M[0] + M[1] * M[1] + M[2] * M[2] + BLUR_PX2;
    c11 = M[3] * M[3] + M[4] * M[4] + M[5] * M[5] + BLUR_PX2;
    c01 = M[0] * M[3] + M[1] * M[4] + M[2] * M[5];
  }
  // The gradient by the camera coordinates, from those by the centre's pixel, by pz itself and by W.
  INLINE_MEMBER void backward(const Camera& c, const Lanes& vx, const Lanes& vy, const Lanes& vz, const Lanes (&vW)[6],
                              Lanes (&out)[3]) const {
    if constexpr (DISTORTION) return distorted_backward(c, vx, vy, vz, vW, out);
    Lanes j00{}, j02{}, j11{}, j12{};
    for (int i = 0; i < 3; i++) {
      j00 += vW[i] * c.R[i], j02 += vW[i] * c.R[6 + i];
      j11 += vW[3 + i] * c.R[3 + i], j12 += vW[3 + i] * c.R[6 + i];
    }
    const Lanes rz2 = rz * rz;
    Lanes vpx = vx * c.fx * rz, vpy = vy * c.fy * rz, vpz = vz - (vx * c.fx * px + vy * c.fy * py) * rz2;
    vpz += (j02 * c.fx * u + j12 * c.fy * v) * rz2 - (j00 * c.fx + j11 * c.fy) * rz2;
    // A limited point of linearisation does not move with the Gaussian.
    const Lanes vu = keep(-j02 * c.fx * rz, ~u_limited), vv = keep(-j12 * c.fy * rz, ~v_limited);
    vpx += vu * rz, vpy += vv * rz, vpz = vpz - (vu * px + vv * py) * rz2;
    out[0] = vpx, out[1] = vpy, out[2] = vpz;
  }
  INLINE_MEMBER void distorted_backward(const Camera& c, const Lanes& vx, const Lanes& vy, const Lanes& vz,
                                        const Lanes (&vW)[6], Lanes (&out)[3]) const {
    const Lanes ux = px * rz, uy = py * rz, fx = c.fx * rz, fy = c.fy * rz;
    const DistortedPoint distorted_center(c, ux, uy), distorted(c, u, v);
    const Lanes J[4] = {fx * distorted.xx, fx * distorted.xy, fy * distorted.xy, fy * distorted.yy};
    // J's columns on x and y, and what its third one, -u and -v times these, adds to them.
    Lanes vJ[4] = {}, third[2] = {};
    for (int row = 0; row < 2; row++) {
      for (int i = 0; i < 3; i++) {
        vJ[2 * row] += vW[3 * row + i] * c.R[i], vJ[2 * row + 1] += vW[3 * row + i] * c.R[3 + i];
        third[row] += vW[3 * row + i] * c.R[6 + i];
      }
      vJ[2 * row] = vJ[2 * row] - u * third[row], vJ[2 * row + 1] = vJ[2 * row + 1] - v * third[row];
    }
    Lanes vu = -(J[0] * third[0] + J[2] * third[1]), vv = -(J[1] * third[0] + J[3] * third[1]);
    DistortedPoint::slopes_backward(c, u, v, fx * vJ[0], fx * vJ[1] + fy * vJ[2], fy * vJ[3], vu, vv);
    const Lanes bx = c.fx * vx, by = c.fy * vy;
    vu = keep(vu, ~u_limited) + bx * distorted_center.xx + by * distorted_center.xy;
    vv = keep(vv, ~v_limited) + bx * distorted_center.xy + by * distorted_center.yy;
    out[0] = vu * rz, out[1] = vv * rz;
    out[2] = vz - (vu * ux + vv * uy + J[0] * vJ[0] + J[1] * vJ[1] + J[2] * vJ[2] + J[3] * vJ[3]) * rz;
  }
  // det(M M^T + blur) by Lagrange's identity: c00 c11 - c01^2 loses everything to cancellation for long thin footprints.
  INLINE_MEMBER Lanes determinant() const {
    Lanes x = M[1] * M[5] - M[2] * M[4], y = M[2] * M[3] - M[0] * M[5], z = M[0] * M[4] - M[1] * M[3];
    return x * x + y * y + z * z + BLUR_PX2 * (c00 + c11 - BLUR_PX2);
  }
  // det(M M^T) over the determinant above: the square of what anti-aliasing leaves of an opacity.
  INLINE_MEMBER Lanes compensation_squared(const Lanes& det) const {
    Lanes x = M[1] * M[5] - M[2] * M[4], y = M[2] * M[3] - M[0] * M[5], z = M[0] * M[4] - M[1] * M[3];
    return (x * x + y * y + z * z) / det;
  }
};

enum Cull { NON_FINITE, QUATERNION, BEHIND, DEGENERATE, FOLDED, CULL_REASONS };

// Writes the footprints of those of the `count` Gaussians from `first` on (up to LANES) that are drawn, and their ids, with a
// rolling shutter also their depths at the pose's time; returns how many. Counts by reason what is left out. Comparisons are
// written so that a NaN culls. GENRE_ABLATE_GUARDS, for timing only: Gaussians are drawn that should be culled.
template <bool ROLLING_SHUTTER, bool DISTORTION, bool ANTIALIASED>
INLINE int footprints(const Camera& c, const GaussianArrays& in, uint32_t first, int count, long long* culled,
                      Footprint* out, uint32_t* ids, float* posed_z) {
  uint32_t id[LANES];
  for (int i = 0; i < LANES; i++) id[i] = first + std::min(i, count - 1);
  const GaussianLanes<ROLLING_SHUTTER> g(in, id);
  const CameraPosition<ROLLING_SHUTTER, DISTORTION> camera_position(c, g);
  const Lanes opacity = gather(in.opacities, 1, id);
  const Lanes color[3] = {gather(in.colors, 3, id), gather(in.colors + 1, 3, id), gather(in.colors + 2, 3, id)};
  uint32_t left = count == LANES ? 0xffffu : (1u << count) - 1;
  auto drop = [&](uint32_t valid, int reason) { culled[reason] += __builtin_popcount(left & ~valid), left &= valid; };

  Mask finite = is_finite(opacity);
  for (int k = 0; k < 3; k++) finite = finite & is_finite(g.mean[k]) & is_finite(g.scale[k]) & is_finite(color[k]);
  for (int k = 0; k < 4; k++) finite = finite & is_finite(g.quat[k]);
  if constexpr (ROLLING_SHUTTER)
    for (int k = 0; k < 3; k++) finite = finite & is_finite(g.velocity[k]);
#ifndef GENRE_ABLATE_GUARDS
  drop(bits(finite), NON_FINITE);
  drop(bits(norm2(g.quat) >= QUAT_MIN_NORM2), QUATERNION);
#endif
  drop(bits(camera_position.ahead()), BEHIND);
  if constexpr (DISTORTION) drop(bits(camera_position.unfolded(c)), FOLDED);
  left &= bits(opacity >= ALPHA_MIN);
  if (!left) return 0;
  const Projection<DISTORTION> p(c, g, camera_position);
  const Lanes det = p.determinant(), &x = p.x, &y = p.y;
#ifndef GENRE_ABLATE_GUARDS
  drop(bits((det > 0.f) & (p.c00 <= MAX_VARIANCE_PX2) & (p.c11 <= MAX_VARIANCE_PX2) & (abs(x) <= MAX_CENTER_PX) &
            (abs(y) <= MAX_CENTER_PX) & is_finite(p.pz)), DEGENERATE);
#endif
  Lanes log2_opacity;
  if constexpr (ANTIALIASED) {
    const Lanes compensated_opacity = opacity * max(sqrt(p.compensation_squared(det)), broadcast(COMPENSATION_MIN));
    left &= bits(compensated_opacity >= ALPHA_MIN);
    for (int i = 0; i < LANES; i++) log2_opacity[i] = std::log2(compensated_opacity[i]);
  } else {
    for (int i = 0; i < LANES; i++) log2_opacity[i] = std::log2(opacity[i]);
  }
  const Lanes level = (log2_opacity - LOG2_ALPHA_MIN) * 1.001f + 1e-4f, t = 2 / LOG2E * level;
  const Lanes half_x = sqrt(t * p.c00), half_y = sqrt(t * p.c11);
  left &= bits((x + half_x >= 0.5f) & (x - half_x <= c.width - 0.5f) & (y + half_y >= 0.5f) & (y - half_y <= c.height - 0.5f));
  if (!left) return 0;
  const Lanes a = .5f * LOG2E * p.c11 / det, dy_per_dx = p.c01 / p.c00;
  const Lanes fields[16] = {x, y, a, -p.c01 / p.c11, .5f * LOG2E / p.c11, log2_opacity, color[0], color[1], color[2], p.pz,
                            level, half_y, dy_per_dx * half_x, dy_per_dx, 1.f / a, opacity};
  int n = 0;
  for (; left; left &= left - 1, n++) {
    const int lane = __builtin_ctz(left);
    float* at = reinterpret_cast<float*>(out + n);
    for (int k = 0; k < 16; k++) at[k] = fields[k][lane];
    ids[n] = first + lane;
    if constexpr (ROLLING_SHUTTER) posed_z[n] = camera_position.posed.position[2][lane];
  }
  return n;
}

// Sums over pixels for one Gaussian, in the order in which the blend's backward makes them; v = -dL/dsigma.
enum Sum { S_V, S_S, S_SS, S_SY, S_Y, S_YY, S_RED, S_GREEN, S_BLUE, S_Z };
enum Attribute { MEAN = 0, SCALE = 3, QUAT = 6, OPACITY = 10, COLOR = 11, ATTRIBUTES = 14 };
constexpr int RESIDUAL_SUMS = ALL_SUMS - SUMS;  // behind these: how much of a residual image a Gaussian covers

// Gradient of the 14 attributes of the Gaussians `id` (LANES of them), whose footprints are drawn[footprint_index], from their
// sums.
template <bool ROLLING_SHUTTER, bool DISTORTION, bool ANTIALIASED>
INLINE void project_backward(const Camera& c, const GaussianArrays& in, const uint32_t* id, const Footprint* drawn,
                             const uint32_t* footprint_index, const Lanes (&sum)[SUMS], Lanes (&out)[ATTRIBUTES]) {
  const float* fields = reinterpret_cast<const float*>(drawn);
  out[OPACITY] = sum[S_V] / gather(fields + offsetof(Footprint, opacity) / 4, 16, footprint_index);
  out[COLOR] = sum[S_RED], out[COLOR + 1] = sum[S_GREEN], out[COLOR + 2] = sum[S_BLUE];
  // The inverse covariance is diag(A, M) in (s, dy): its product with d is (A s, k A s + M dy).
  const Lanes A = 2 / LOG2E * gather(fields + offsetof(Footprint, a) / 4, 16, footprint_index),
              M = 2 / LOG2E * gather(fields + offsetof(Footprint, m) / 4, 16, footprint_index),
              k = gather(fields + offsetof(Footprint, k) / 4, 16, footprint_index);
  const Lanes vx = A * sum[S_S], vy = k * vx + M * sum[S_Y];
  const Lanes ss = .5f * A * A * sum[S_SS], sy = .5f * A * M * sum[S_SY], yy = .5f * M * M * sum[S_YY];
  const GaussianLanes<ROLLING_SHUTTER> g(in, id);
  const CameraPosition<ROLLING_SHUTTER, DISTORTION> camera_position(c, g);
  const Projection<DISTORTION> p(c, g, camera_position);
  Lanes vM[6], vU[6], vR[9], vW[6];
  // M0 + k M1, by which M's first row differs from a multiple of the second: by Lagrange's identity, since the plain difference
  // cancels for long thin footprints. dL/dcovariance is
  // ss (1, k)(1, k)^T + sy ((1, k)(0, 1)^T + (0, 1)(1, k)^T) + yy (0, 1)(0, 1)^T.
  const Lanes *M0 = p.M, *M1 = p.M + 3;
  const Lanes n[3] = {M0[1] * M1[2] - M0[2] * M1[1], M0[2] * M1[0] - M0[0] * M1[2], M0[0] * M1[1] - M0[1] * M1[0]};
  const Lanes inv_c11 = 1.f / p.c11;
  // Anti-aliasing: log2_opacity moves with half the log of det(M M^T) / det(M M^T + blur), whose slopes by M's rows are
  // M1 x n and n x M0, times across, less `wider` of the rows themselves. S_V is dL/dlog(opacity).
  Lanes across, wider;
  if constexpr (ANTIALIASED) {
    const Lanes det = p.determinant(), compensation2 = p.compensation_squared(det);
    const Lanes pull = keep(sum[S_V], compensation2 > COMPENSATION_MIN * COMPENSATION_MIN);
    across = pull * (1.f - compensation2) / max(compensation2 * det, broadcast(1e-30f)), wider = pull * BLUR_PX2 / det;
  }
  for (int i = 0; i < 3; i++) {
    const int j = (i + 1) % 3, l = (i + 2) % 3;
    const Lanes difference = (M1[j] * n[l] - M1[l] * n[j] + BLUR_PX2 * M0[i]) * inv_c11;
    vM[i] = 2.f * (ss * difference + sy * M1[i]), vM[3 + i] = k * vM[i] + 2.f * (sy * difference + yy * M1[i]);
    if constexpr (ANTIALIASED) {
      vM[i] += across * (M1[j] * n[l] - M1[l] * n[j]) - wider * M0[i];
      vM[3 + i] += across * (n[j] * M0[l] - n[l] * M0[j]) - wider * M1[i];
    }
    out[SCALE + i] = vM[i] * p.U[i] + vM[3 + i] * p.U[3 + i];
    vU[i] = vM[i] * g.scale[i], vU[3 + i] = vM[3 + i] * g.scale[i];
  }
  for (int a = 0; a < 3; a++) {
    for (int i = 0; i < 3; i++) vR[3 * a + i] = p.W[a] * vU[i] + p.W[3 + a] * vU[3 + i];
    vW[a] = vU[0] * p.Rq[3 * a] + vU[1] * p.Rq[3 * a + 1] + vU[2] * p.Rq[3 * a + 2];
    vW[3 + a] = vU[3] * p.Rq[3 * a] + vU[4] * p.Rq[3 * a + 1] + vU[5] * p.Rq[3 * a + 2];
  }
  const Lanes &w = p.q[0], &x = p.q[1], &y = p.q[2], &z = p.q[3];
  Lanes gw = 2.f * (x * (vR[7] - vR[5]) + y * (vR[2] - vR[6]) + z * (vR[3] - vR[1]));
  Lanes gx = 2.f * (-2.f * x * (vR[4] + vR[8]) + y * (vR[1] + vR[3]) + z * (vR[2] + vR[6]) + w * (vR[7] - vR[5]));
  Lanes gy = 2.f * (x * (vR[1] + vR[3]) - 2.f * y * (vR[0] + vR[8]) + z * (vR[5] + vR[7]) + w * (vR[2] - vR[6]));
  Lanes gz = 2.f * (x * (vR[2] + vR[6]) + y * (vR[5] + vR[7]) - 2.f * z * (vR[0] + vR[4]) + w * (vR[3] - vR[1]));
  Lanes along = gw * w + gx * x + gy * y + gz * z;  // (v - (v.q)q) / |q|: the length has no gradient
  out[QUAT] = (gw - along * w) * p.inv_norm, out[QUAT + 1] = (gx - along * x) * p.inv_norm;
  out[QUAT + 2] = (gy - along * y) * p.inv_norm, out[QUAT + 3] = (gz - along * z) * p.inv_norm;
  Lanes at[3], grad_shear[2];
  camera_position.shear_backward(p.unsheared, vW, grad_shear);
  p.backward(c, vx, vy, sum[S_Z], vW, at);
  camera_position.backward(c, grad_shear, at);
  for (int i = 0; i < 3; i++) out[MEAN + i] = c.R[i] * at[0] + c.R[3 + i] * at[1] + c.R[6 + i] * at[2];
}
