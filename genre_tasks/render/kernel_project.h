// From a Gaussian to its footprint on the image, and the way back. M = J R_camera R_gaussian S is 2x3 and the projected
// covariance is M M^T: the 3x3 covariance is never formed.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "kernel_simd.h"

constexpr float LOG2E = 1.4426950408889634f;
const float LOG2_ALPHA_MIN = std::log2(ALPHA_MIN);

struct Camera {
  float R[9], t[3], fx, fy, cx, cy;
  int width, height;
  float right, left, bottom, top;  // limits of x/z and y/z at which the projection is linearised
};

// pose: row-major 4x4, chunk to camera; lens: fx, fy, cx, cy.
static Camera make_camera(const float* pose, const float* lens, int width, int height) {
  Camera c;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) c.R[3 * i + j] = pose[4 * i + j];
    c.t[i] = pose[4 * i + 3];
  }
  c.fx = lens[0], c.fy = lens[1], c.cx = lens[2], c.cy = lens[3], c.width = width, c.height = height;
  float mx = JACOBIAN_MARGIN * .5f * width / c.fx, my = JACOBIAN_MARGIN * .5f * height / c.fy;
  c.right = (width - c.cx) / c.fx + mx, c.left = c.cx / c.fx + mx;
  c.bottom = (height - c.cy) / c.fy + my, c.top = c.cy / c.fy + my;
  return c;
}

// A footprint: alpha(d) = 2^(log2_opacity - a dx^2 - b dx dy - c dy^2). One cache line.
struct alignas(64) Footprint {
  float x, y, a, b, c, log2_opacity, red, green, blue, z, half_x, half_y, dy_at_right, inv_2a, discriminant, opacity;
};

// a dx^2 + b dx dy + c dy^2 where alpha falls below the skip; widened so that rounding never cuts a pixel off.
INLINE float cut_level(const Footprint& g) { return (g.log2_opacity - LOG2_ALPHA_MIN) * 1.001f + 1e-4f; }

struct Projection {
  float px, py, pz, rz, u, v;
  bool u_limited, v_limited;
  float W[6], Rq[9], U[6], M[6], c00, c01, c11, q[4], inv_norm;
};

INLINE void rotate(const float* quat, Projection& o) {
  float s = 1.f, n2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
  if (n2 > 1e30f) {  // the squares of a long quaternion overflow, its direction does not
    s = 1e-20f, n2 = 0;
    for (int i = 0; i < 4; i++) n2 += (quat[i] * s) * (quat[i] * s);
  }
  float inv = 1.f / std::sqrt(n2);
  o.inv_norm = inv * s;
  float w = o.q[0] = quat[0] * s * inv, x = o.q[1] = quat[1] * s * inv, y = o.q[2] = quat[2] * s * inv,
        z = o.q[3] = quat[3] * s * inv;
  float* R = o.Rq;
  R[0] = 1 - 2 * (y * y + z * z), R[1] = 2 * (x * y - w * z), R[2] = 2 * (x * z + w * y);
  R[3] = 2 * (x * y + w * z), R[4] = 1 - 2 * (x * x + z * z), R[5] = 2 * (y * z - w * x);
  R[6] = 2 * (x * z - w * y), R[7] = 2 * (y * z + w * x), R[8] = 1 - 2 * (x * x + y * y);
}

INLINE float depth_of(const Camera& c, const float* m) { return c.R[6] * m[0] + c.R[7] * m[1] + c.R[8] * m[2] + c.t[2]; }

INLINE void project(const Camera& c, const float* m, const float* s, const float* q, Projection& o) {
  o.px = c.R[0] * m[0] + c.R[1] * m[1] + c.R[2] * m[2] + c.t[0];
  o.py = c.R[3] * m[0] + c.R[4] * m[1] + c.R[5] * m[2] + c.t[1];
  o.pz = depth_of(c, m), o.rz = 1.f / o.pz;
  float ux = o.px * o.rz, uy = o.py * o.rz;
  o.u = std::min(c.right, std::max(-c.left, ux)), o.v = std::min(c.bottom, std::max(-c.top, uy));
  o.u_limited = o.u != ux, o.v_limited = o.v != uy;
  float j00 = c.fx * o.rz, j02 = -c.fx * o.u * o.rz, j11 = c.fy * o.rz, j12 = -c.fy * o.v * o.rz;
  for (int k = 0; k < 3; k++) o.W[k] = j00 * c.R[k] + j02 * c.R[6 + k], o.W[3 + k] = j11 * c.R[3 + k] + j12 * c.R[6 + k];
  rotate(q, o);
  const float* R = o.Rq;
  for (int k = 0; k < 3; k++) {
    o.U[k] = o.W[0] * R[k] + o.W[1] * R[3 + k] + o.W[2] * R[6 + k];
    o.U[3 + k] = o.W[3] * R[k] + o.W[4] * R[3 + k] + o.W[5] * R[6 + k];
    o.M[k] = o.U[k] * s[k], o.M[3 + k] = o.U[3 + k] * s[k];
  }
  const float* M = o.M;
  o.c00 = M[0] * M[0] + M[1] * M[1] + M[2] * M[2] + BLUR_PX2;
  o.c11 = M[3] * M[3] + M[4] * M[4] + M[5] * M[5] + BLUR_PX2;
  o.c01 = M[0] * M[3] + M[1] * M[4] + M[2] * M[5];
}

// det(M M^T + blur) by Lagrange's identity: c00 c11 - c01^2 loses everything to cancellation for long thin footprints.
INLINE float determinant(const Projection& p) {
  const float* M = p.M;
  float x = M[1] * M[5] - M[2] * M[4], y = M[2] * M[3] - M[0] * M[5], z = M[0] * M[4] - M[1] * M[3];
  return x * x + y * y + z * z + BLUR_PX2 * (p.c00 + p.c11 - BLUR_PX2);
}

enum Cull { NON_FINITE, QUATERNION, BEHIND, DEGENERATE, CULL_REASONS, ORDINARY = CULL_REASONS, DRAWN };

// On the bits: stays right under any floating-point flags.
INLINE bool all_finite(const float* x, int n) {
  uint32_t bad = 0;
  for (int i = 0; i < n; i++) {
    uint32_t u;
    std::memcpy(&u, x + i, 4);
    bad |= (u & 0x7f800000u) == 0x7f800000u;
  }
  return !bad;
}

// Fills `g` and returns DRAWN, or says why the Gaussian is left out. Comparisons are written so that a NaN culls.
INLINE int footprint(const Camera& c, const float* m, const float* s, const float* q, float opacity, const float* color,
                     Projection& p, Footprint& g) {
  if (!(all_finite(m, 3) && all_finite(s, 3) && all_finite(q, 4) && all_finite(&opacity, 1) && all_finite(color, 3)))
    return NON_FINITE;
  if (!(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] >= QUAT_MIN_NORM2)) return QUATERNION;
  if (!(depth_of(c, m) >= NEAR_M)) return BEHIND;
  if (!(opacity >= ALPHA_MIN)) return ORDINARY;
  project(c, m, s, q, p);
  float det = determinant(p);
  g.x = c.fx * p.px * p.rz + c.cx, g.y = c.fy * p.py * p.rz + c.cy;
  bool sound = det > 0 && p.c00 <= MAX_VARIANCE_PX2 && p.c11 <= MAX_VARIANCE_PX2 && std::fabs(g.x) <= MAX_CENTER_PX &&
               std::fabs(g.y) <= MAX_CENTER_PX;
  if (!sound) return DEGENERATE;
  g.log2_opacity = std::log2(opacity);
  float t = 2 / LOG2E * cut_level(g);
  g.half_x = std::sqrt(t * p.c00), g.half_y = std::sqrt(t * p.c11);
  if (!(g.x + g.half_x >= 0.5f && g.x - g.half_x <= c.width - 0.5f && g.y + g.half_y >= 0.5f && g.y - g.half_y <= c.height - 0.5f))
    return ORDINARY;
  float k = LOG2E / det;
  g.a = .5f * p.c11 * k, g.b = -p.c01 * k, g.c = .5f * p.c00 * k, g.discriminant = LOG2E * k;  // 4ac - b^2
  g.opacity = opacity, g.red = color[0], g.green = color[1], g.blue = color[2], g.z = p.pz;
  g.dy_at_right = -g.b / (2 * g.c) * g.half_x, g.inv_2a = 1 / (2 * g.a);
  return DRAWN;
}

// Sums over pixels for one Gaussian, in the order in which the blend's backward makes them; v = -dL/dsigma.
enum Sum { S_V, S_VX, S_VXX, S_VXY, S_VY, S_VYY, S_RED, S_GREEN, S_BLUE, S_Z };
enum Attribute { MEAN = 0, SCALE = 3, QUAT = 6, OPACITY = 10, COLOR = 11, ATTRIBUTES = 14 };

// Gradient of the 14 attributes, out[ATTRIBUTES], from the ten sums.
INLINE void project_backward(const Camera& c, const Footprint& g, const float* m, const float* s, const float* q,
                             const float* sum, float* out) {
  out[OPACITY] = sum[S_V] / g.opacity;
  out[COLOR] = sum[S_RED], out[COLOR + 1] = sum[S_GREEN], out[COLOR + 2] = sum[S_BLUE];
  const float A = 2 * g.a / LOG2E, B = g.b / LOG2E, C = 2 * g.c / LOG2E;  // the inverse covariance
  float vx = A * sum[S_VX] + B * sum[S_VY], vy = B * sum[S_VX] + C * sum[S_VY];
  // dL/dcovariance = -conic V conic with V = dL/dconic
  float v00_ = -.5f * sum[S_VXX], h = -.5f * sum[S_VXY], v11_ = -.5f * sum[S_VYY];
  float k00 = A * v00_ + B * h, k01 = A * h + B * v11_, k10 = B * v00_ + C * h, k11 = B * h + C * v11_;
  float v00 = -(k00 * A + k01 * B), v01 = -(k00 * B + k01 * C), v11 = -(k10 * B + k11 * C);
  Projection p;
  project(c, m, s, q, p);
  float vM[6], vU[6], vR[9], vW[6];
  for (int k = 0; k < 3; k++) {
    vM[k] = 2 * (v00 * p.M[k] + v01 * p.M[3 + k]), vM[3 + k] = 2 * (v01 * p.M[k] + v11 * p.M[3 + k]);
    out[SCALE + k] = vM[k] * p.U[k] + vM[3 + k] * p.U[3 + k];
    vU[k] = vM[k] * s[k], vU[3 + k] = vM[3 + k] * s[k];
  }
  for (int a = 0; a < 3; a++) {
    for (int k = 0; k < 3; k++) vR[3 * a + k] = p.W[a] * vU[k] + p.W[3 + a] * vU[3 + k];
    vW[a] = vU[0] * p.Rq[3 * a] + vU[1] * p.Rq[3 * a + 1] + vU[2] * p.Rq[3 * a + 2];
    vW[3 + a] = vU[3] * p.Rq[3 * a] + vU[4] * p.Rq[3 * a + 1] + vU[5] * p.Rq[3 * a + 2];
  }
  float w = p.q[0], x = p.q[1], y = p.q[2], z = p.q[3];
  float gw = 2 * (x * (vR[7] - vR[5]) + y * (vR[2] - vR[6]) + z * (vR[3] - vR[1]));
  float gx = 2 * (-2 * x * (vR[4] + vR[8]) + y * (vR[1] + vR[3]) + z * (vR[2] + vR[6]) + w * (vR[7] - vR[5]));
  float gy = 2 * (x * (vR[1] + vR[3]) - 2 * y * (vR[0] + vR[8]) + z * (vR[5] + vR[7]) + w * (vR[2] - vR[6]));
  float gz = 2 * (x * (vR[2] + vR[6]) + y * (vR[5] + vR[7]) - 2 * z * (vR[0] + vR[4]) + w * (vR[3] - vR[1]));
  float along = gw * w + gx * x + gy * y + gz * z;  // (v - (v.q)q) / |q|: the length has no gradient
  out[QUAT] = (gw - along * w) * p.inv_norm, out[QUAT + 1] = (gx - along * x) * p.inv_norm;
  out[QUAT + 2] = (gy - along * y) * p.inv_norm, out[QUAT + 3] = (gz - along * z) * p.inv_norm;
  float j00 = 0, j02 = 0, j11 = 0, j12 = 0;
  for (int k = 0; k < 3; k++) {
    j00 += vW[k] * c.R[k], j02 += vW[k] * c.R[6 + k];
    j11 += vW[3 + k] * c.R[3 + k], j12 += vW[3 + k] * c.R[6 + k];
  }
  float rz = p.rz, rz2 = rz * rz;
  float vpx = vx * c.fx * rz, vpy = vy * c.fy * rz, vpz = sum[S_Z] - (vx * c.fx * p.px + vy * c.fy * p.py) * rz2;
  vpz += -(j00 * c.fx + j11 * c.fy) * rz2 + (j02 * c.fx * p.u + j12 * c.fy * p.v) * rz2;
  float vu = -j02 * c.fx * rz, vv = -j12 * c.fy * rz;
  if (!p.u_limited) vpx += vu * rz, vpz -= vu * p.px * rz2;
  if (!p.v_limited) vpy += vv * rz, vpz -= vv * p.py * rz2;
  for (int k = 0; k < 3; k++) out[MEAN + k] = c.R[k] * vpx + c.R[3 + k] * vpy + c.R[6 + k] * vpz;
}
