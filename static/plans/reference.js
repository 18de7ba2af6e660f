// Regions of a reference picture: drawn by mouse or touch, or typed, and saved as a new reference.

import { post } from "../site/api.js";
import { t } from "../site/sentences.js";
import { fromPoints, withValue, unusedName, MIN_SIDE, translate } from "./rectangles.js";

const NUMBERS = ["x", "y", "width", "height"];
const CROP = 96; // longer side of a preview [px]

class Drawing {
  #picture = document.getElementById("drawing");
  #image = this.#picture.querySelector("img");
  #rows = document.getElementById("region-rows");
  #pattern = document.getElementById("region-row");
  #said = document.getElementById("said");
  #save = document.getElementById("save-regions");
  #regions;
  #most;

  constructor({ regions, most, save, next }) {
    this.#regions = regions;
    this.#most = most;
    this.#picture.addEventListener("pointerdown", (event) => this.#pressed(event));
    this.#rows.addEventListener("input", (event) => this.#typed(event.target));
    this.#rows.addEventListener("change", () => this.#show());
    this.#rows.addEventListener("click", (event) => this.#removed(event.target.closest("[data-remove]")));
    document.getElementById("add-region").addEventListener("click", () => this.#add({ x: 0.4, y: 0.4, width: 0.2, height: 0.2 }));
    this.#save.addEventListener("click", () => this.#sent(save, next));
    if (!this.#image.complete) this.#image.addEventListener("load", () => this.#show());
    this.#show();
  }

  #at(event) {
    const box = this.#image.getBoundingClientRect();
    return { x: (event.clientX - box.left) / box.width, y: (event.clientY - box.top) / box.height };
  }

  /** Start a drag: on a region it moves the region, at a region's corner it resizes it, elsewhere it draws a new one. */
  #pressed(event) {
    if (event.button !== 0) return;
    event.preventDefault();
    const from = this.#at(event);
    const pressed = event.target.closest("[data-region]");
    const index = pressed ? Number(pressed.dataset.region) : this.#regions.length;
    const before = this.#regions[index];
    if (!before && this.#regions.length >= this.#most) {
      this.#tell(t("page.reference.most", "A picture has at most {most} regions", { most: this.#most }));
      return;
    }
    const sized = event.target.matches(".region-corner");
    const drag = (later) => {
      const to = this.#at(later);
      if (!before) this.#regions[index] = { name: this.#regions[index]?.name ?? this.#fresh(), ...fromPoints(from, to) };
      else if (sized) this.#regions[index] = { ...before, ...fromPoints(before, to) };
      else this.#regions[index] = translate(before, to.x - from.x, to.y - from.y);
      this.#show();
    };
    const end = (last) => {
      this.#picture.removeEventListener("pointermove", drag);
      for (const kind of ["pointerup", "pointercancel"]) this.#picture.removeEventListener(kind, end);
      const made = this.#regions[index];
      if (last.type === "pointercancel" || (made && Math.min(made.width, made.height) < MIN_SIDE)) {
        this.#regions.splice(index, 1, ...(before ? [before] : []));
      } else if (made && !before) this.#name(index);
      this.#show();
    };
    this.#picture.setPointerCapture(event.pointerId);
    this.#picture.addEventListener("pointermove", drag);
    for (const kind of ["pointerup", "pointercancel"]) this.#picture.addEventListener(kind, end);
  }

  #fresh() {
    return unusedName(this.#regions.map((region) => region.name));
  }

  #add(rectangle) {
    if (this.#regions.length >= this.#most) return this.#tell(t("page.reference.most", "A picture has at most {most} regions", { most: this.#most }));
    this.#regions.push({ name: this.#fresh(), ...rectangle });
    return this.#name(this.#regions.length - 1);
  }

  #name(index) {
    this.#show();
    const field = this.#rows.children[index].querySelector("[data-of=name]");
    field.focus({ preventScroll: true });
    field.select();
  }

  #typed(field) {
    const index = Number(field.closest("[data-row]").dataset.row);
    const region = this.#regions[index];
    if (field.dataset.of === "name") region.name = field.value;
    else this.#regions[index] = withValue(region, field.dataset.of, Number(field.value) / 100);
    this.#draw();
  }

  #removed(button) {
    if (!button) return;
    this.#regions.splice(Number(button.closest("[data-row]").dataset.row), 1);
    this.#show();
    document.getElementById("add-region").focus();
  }

  #show() {
    while (this.#rows.children.length > this.#regions.length) this.#rows.lastElementChild.remove();
    while (this.#rows.children.length < this.#regions.length) this.#rows.append(this.#pattern.content.cloneNode(true));
    this.#regions.forEach((region, index) => {
      const row = this.#rows.children[index];
      row.dataset.row = index;
      row.querySelector("[data-of=name]").value = region.name;
      for (const key of NUMBERS) row.querySelector(`[data-of=${key}]`).value = (100 * region[key]).toFixed(1);
      row.querySelector("[data-remove]").setAttribute("aria-label", t("page.reference.remove", "Remove {name}", { name: region.name }));
    });
    document.getElementById("no-regions").hidden = this.#regions.length > 0;
    this.#draw();
  }

  /** Draw the rectangles over the picture, and a preview of what each cuts out. */
  #draw() {
    const boxes = this.#regions.map((region, index) => {
      const box = document.createElement("div");
      box.className = "region";
      box.dataset.region = index;
      for (const [side, key] of [["left", "x"], ["top", "y"], ["width", "width"], ["height", "height"]]) box.style[side] = `${100 * region[key]}%`;
      const corner = document.createElement("span");
      corner.className = "region-corner";
      const name = document.createElement("span");
      name.className = "region-name";
      name.textContent = region.name;
      box.append(name, corner);
      cut(this.#rows.children[index].querySelector("canvas"), this.#image, region);
      return box;
    });
    for (const box of this.#picture.querySelectorAll(".region")) box.remove();
    this.#picture.append(...boxes);
  }

  async #sent(address, next) {
    this.#save.disabled = true;
    try {
      const made = await post(address, { regions: this.#regions });
      location.assign(next.replace("/0/", `/${made.id}/`));
    } catch (error) {
      this.#tell(t("page.reference.not_saved", "Not saved: {why}", { why: error.message }));
      this.#save.disabled = false;
    }
  }

  #tell(words) {
    this.#said.textContent = words;
  }
}

function cut(canvas, image, { x, y, width, height }) {
  const [full, tall] = [image.naturalWidth, image.naturalHeight];
  const [wide, high] = [width * full, height * tall];
  if (wide < 1 || high < 1) return;
  const scale = CROP / Math.max(wide, high);
  Object.assign(canvas, { width: Math.max(1, Math.round(wide * scale)), height: Math.max(1, Math.round(high * scale)) });
  canvas.getContext("2d").drawImage(image, x * full, y * tall, wide, high, 0, 0, canvas.width, canvas.height);
}

new Drawing(JSON.parse(document.getElementById("regions").textContent));
