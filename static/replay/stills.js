// Cameras whose pictures are single images of a dataset's column: the next picture is requested when the previous one has
// arrived.

import { t } from "../site/sentences.js";

export class Stills {
  #clock;

  /** `pictures` are [{element, address}], with image elements. */
  constructor(pictures, clock) {
    this.#clock = clock;
    for (const picture of pictures) {
      const follow = () => this.#follow(picture);
      for (const kind of ["tick", "seek"]) clock.addEventListener(kind, follow);
      picture.element.addEventListener("load", () => this.#came(picture));
      picture.element.addEventListener("error", () => this.#failed(picture));
      follow();
    }
  }

  #follow(picture) {
    const { row } = this.#clock;
    if (picture.coming || picture.row === row) return;
    const glue = picture.address.includes("?") ? "&" : "?";
    Object.assign(picture, { coming: true, row });
    picture.element.src = `${picture.address}${glue}row=${row}`;
  }

  #came(picture) {
    picture.coming = false;
    this.#follow(picture);
  }

  #failed(picture) {
    picture.coming = false;
    picture.element.parentElement.querySelector("[data-fault]").textContent = t("page.replay.no_picture", "picture {row} cannot be shown", { row: picture.row });
  }
}
