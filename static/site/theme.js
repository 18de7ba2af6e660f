// Sets the dark or light theme before anything is drawn: as chosen in this browser, else dark at the bench and elsewhere as the
// system has it. This is a classic script, because modules run only after the first paint.
(() => {
  const KEY = "eva-theme";
  const root = document.documentElement;
  const atBench = root.dataset.theme === "dark";
  const system = matchMedia("(prefers-color-scheme: dark)");
  const chosen = () => {
    const found = localStorage.getItem(KEY);
    return found === "dark" || found === "light" ? found : "system";
  };

  function apply() {
    const theme = chosen() === "system" ? (atBench || system.matches ? "dark" : "light") : chosen();
    if (root.dataset.theme === theme) return;
    root.dataset.theme = theme;
    document.dispatchEvent(new Event("eva:theme"));
  }

  apply();
  system.addEventListener("change", apply);
  window.addEventListener("storage", apply); // chosen in another tab
  document.addEventListener("DOMContentLoaded", () => {
    for (const radio of document.querySelectorAll("[data-theme-choice]")) radio.checked = radio.value === chosen();
  });
  document.addEventListener("change", ({ target }) => {
    if (!target.matches("[data-theme-choice]")) return;
    localStorage.setItem(KEY, target.value);
    apply();
  });
})();
