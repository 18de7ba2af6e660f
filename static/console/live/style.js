// Custom properties of the page, for what is drawn on a canvas.

/** Return the present value of a custom property of the page. */
export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
