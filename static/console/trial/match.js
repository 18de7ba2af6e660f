// How well two pictures match: the correlation of their grey values at 64 x 48, as evaweb/plans/image_store.py computes it.

export const WIDTH = 64;
export const HEIGHT = 48;

/** Return the correlation of two arrays of grey values; 1 means equal. Overall brightness and contrast do not count. */
export function correlation(a, b) {
  const [x, y] = [centred(a), centred(b)];
  let both = 0;
  let one = 0;
  let other = 0;
  for (let k = 0; k < x.length; k += 1) {
    both += x[k] * y[k];
    one += x[k] * x[k];
    other += y[k] * y[k];
  }
  const spread = Math.sqrt(one * other);
  return spread > 1e-6 ? both / spread : 0;
}

/** Return the grey values of RGBA pixels. */
export function grey(pixels) {
  const values = new Float64Array(pixels.length / 4);
  for (let k = 0; k < values.length; k += 1) values[k] = 0.299 * pixels[4 * k] + 0.587 * pixels[4 * k + 1] + 0.114 * pixels[4 * k + 2];
  return values;
}

/** Return the cameras whose match is below `least`, worst first: [[name, match], ...]. */
export function below(matches, least) {
  return Object.entries(matches)
    .filter(([, value]) => value < least)
    .sort(([, a], [, b]) => a - b);
}

function centred(values) {
  const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
  return values.map((value) => value - mean);
}
