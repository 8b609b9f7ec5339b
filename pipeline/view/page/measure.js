"use strict";
// Shapes through points, by geometric least squares. Points are [x, y, z] in mm.

// The Gauss-Newton solution for parameters p; `residual(point, p)` gives [r, dr/dp0, dr/dp1, ...].
function leastSquares(points, p, residual) {
  for (let round = 0; round < 30; round++) {
    const n = p.length;
    const normal = Array.from({ length: n }, () => new Float64Array(n + 1));
    for (const point of points) {
      const [r, ...slope] = residual(point, p);
      for (let i = 0; i < n; i++) {
        for (let j = 0; j < n; j++) normal[i][j] += slope[i] * slope[j];
        normal[i][n] -= slope[i] * r;
      }
    }
    const step = solve(normal);
    p = p.map((value, i) => value + step[i]);
    if (Math.hypot(...step) < 1e-9 * (1 + Math.hypot(...p))) break;
  }
  return p;
}

// Solve n equations with their right sides in column n.
function solve(rows) {
  const n = rows.length;
  for (let i = 0; i < n; i++) {
    let best = i;
    for (let k = i + 1; k < n; k++) if (Math.abs(rows[k][i]) > Math.abs(rows[best][i])) best = k;
    [rows[i], rows[best]] = [rows[best], rows[i]];
    if (!rows[i][i]) throw new Error("these points do not determine the shape: choose others");
    for (let k = 0; k < n; k++) {
      if (k === i) continue;
      const factor = rows[k][i] / rows[i][i];
      for (let j = i; j <= n; j++) rows[k][j] -= factor * rows[i][j];
    }
  }
  return rows.map((row, i) => row[n] / row[i]);
}

function mean(points) {
  return [0, 1, 2].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
}

function distance(a, b) {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}

// The plane z = a x + b y + c about the points' middle: `off(point)` is how far a point lies behind it, mm.
function fitPlane(points) {
  const middle = mean(points);
  const [a, b, c] = leastSquares(points, [0, 0, 0], (point, [a, b, c]) => {
    const [x, y, z] = point.map((value, axis) => value - middle[axis]);
    const length = Math.hypot(a, b, 1);
    const r = (z - a * x - b * y - c) / length;
    return [r, -x / length - (r * a) / length ** 2, -y / length - (r * b) / length ** 2, -1 / length];
  });
  const length = Math.hypot(a, b, 1);
  const off = ([x, y, z]) => (z - middle[2] - a * (x - middle[0]) - b * (y - middle[1]) - c) / length;
  return { off, tilt: (Math.atan(Math.hypot(a, b)) * 180) / Math.PI, rms: rms(points.map(off)) };
}

// The sphere, begun with some points of which all are on it. Farther from it than three times what most are lies
// something else, as a rod, or the wall behind a ball.
function fitSphere(points, sure) {
  let kept = sure;
  let sphere = null;
  for (let round = 0; round < 10; round++) {
    sphere = sphereThrough(kept);
    const sizes = points.map((point) => Math.abs(sphere.off(point)));
    const limit = 3 * 1.4826 * median(sizes);
    const inside = points.filter((_, i) => sizes[i] <= limit);
    if (inside.length === kept.length || inside.length < 10) break;
    kept = inside;
  }
  return { ...sphere, used: kept.length };
}

function sphereThrough(points) {
  const middle = mean(points);
  const moved = points.map((point) => point.map((value, axis) => value - middle[axis]));
  // x^2 + y^2 + z^2 = 2 c x + r^2 - c^2 is linear in c and d: near enough to begin with.
  const [cx, cy, cz, d] = leastSquares(moved, [0, 0, 0, 0], (m, [a, b, c, e]) => [
    2 * (a * m[0] + b * m[1] + c * m[2]) + e - m[0] ** 2 - m[1] ** 2 - m[2] ** 2,
    ...m.map((value) => 2 * value),
    1,
  ]);
  const start = [cx, cy, cz, Math.sqrt(d + cx ** 2 + cy ** 2 + cz ** 2)];
  const [x, y, z, radius] = leastSquares(moved, start, (m, [a, b, c, r]) => {
    const away = Math.hypot(m[0] - a, m[1] - b, m[2] - c);
    return [away - r, (a - m[0]) / away, (b - m[1]) / away, (c - m[2]) / away, -1];
  });
  const centre = [x + middle[0], y + middle[1], z + middle[2]];
  const off = (point) => distance(point, centre) - radius;
  return { centre, radius, off, rms: rms(points.map(off)) };
}

function rms(values) {
  return Math.sqrt(values.reduce((sum, value) => sum + value * value, 0) / values.length);
}

function median(values) {
  return Float64Array.from(values).sort()[values.length >> 1];
}

// The value below which a share of some values lies; NaN is left out.
function percentiles(values, shares) {
  const every = Math.max(1, Math.floor(values.length / 100000));
  const known = [];
  for (let i = 0; i < values.length; i += every) if (Number.isFinite(values[i])) known.push(values[i]);
  const sorted = Float64Array.from(known).sort();
  return shares.map((share) => (sorted.length ? sorted[Math.round(share * (sorted.length - 1))] : NaN));
}
