// From the bench to a picture of it: the projection of a plane that four points and their places in the picture fix.

/** The projection that takes four points [x, y] to four others, as nine numbers; null where three of them are in line. */
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

/** Where a point of the plane is in the picture. */
export function seen(h, [x, y]) {
  const depth = h[6] * x + h[7] * y + h[8];
  return [(h[0] * x + h[1] * y + h[2]) / depth, (h[3] * x + h[4] * y + h[5]) / depth];
}

/** Gauss's elimination with the largest pivot; each row ends with its right side. */
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
