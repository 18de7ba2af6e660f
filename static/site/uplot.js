// uPlot, of which only the classic script is minified: it sets a global variable and exports nothing.

/** Load the script at `address`; resolve to uPlot, or null if the script cannot be loaded. */
export function loadPlots(address) {
  return new Promise((resolve) => {
    const script = document.createElement("script");
    script.src = address;
    script.addEventListener("load", () => resolve(window.uPlot));
    script.addEventListener("error", () => resolve(null));
    document.head.append(script);
  });
}
