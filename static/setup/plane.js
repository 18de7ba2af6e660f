// The projection from the bench to a picture of it, as four points of a plane and their places in the picture define it.

/** Return the projection that maps four points [x, y] to four others, as nine numbers; null if three of them are collinear. */
export function projection(from, to) {
  const rows = from.flatMap(([x, y], k) => {
    const [u, v] = to[k];
    return [
      [x, y, 1, 0, 0, 0, -u * x, -u * y, u],
      [0, 0, 0, x, y, 1, -v * x, -v * y, v],
    ];
  });
  const found = solved(rows);
  return found && [...found, 1];
}

/** Return where a point of the plane lies in the picture. */
export function seen(h, [x, y]) {
  const depth = h[6] * x + h[7] * y + h[8];
  return [(h[0] * x + h[1] * y + h[2]) / depth, (h[3] * x + h[4] * y + h[5]) / depth];
}

/**
 * Solve linear equations by Gaussian elimination with the largest pivot; each row ends with its right side. Return null if they
 * are singular.
 */
function solved(rows) {
  const size = rows.length;
  for (let k = 0; k < size; k += 1) {
    const pivot = rows.slice(k).reduce((best, row, index) => (Math.abs(row[k]) > Math.abs(rows[best][k]) ? k + index : best), k);
    [rows[k], rows[pivot]] = [rows[pivot], rows[k]];
    if (Math.abs(rows[k][k]) < 1e-12) return null;
    for (let other = 0; other < size; other += 1) {
      if (other === k) continue;
      const factor = rows[other][k] / rows[k][k];
      for (let column = k; column <= size; column += 1) rows[other][column] -= factor * rows[k][column];
    }
  }
  return rows.map((row, k) => row[size] / row[k]);
}
