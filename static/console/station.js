// Puts together everything that the page of a station shows and requests.

import { CollectPanel } from "../collect/collect.js";
import { drafts } from "../site/drafts.js";
import { quietFragments } from "../site/fragments.js";
import { reasoned, sentence } from "../site/sentences.js";
import { pageId } from "../site/identity.js";
import { byHand } from "./manual/by_hand.js";
import { Cameras } from "./live/cameras.js";
import { Commands } from "./commands/commands.js";
import { config } from "./live/config.js";
import { curvePane } from "./curves/curve_controls.js";
import { figures } from "./debug/debug.js";
import { drawFrame, panes } from "./live/drawing.js";
import { EStop } from "./commands/estop.js";
import { Events } from "./live/events.js";
import { keyboard } from "./commands/keys.js";
import { LeaseControls } from "./commands/lease.js";
import { preflights } from "./trial/preflight.js";
import { regionView } from "./trial/region_view.js";
import { resetAid } from "./trial/reset_aid.js";
import { scenePane } from "./scene/scene_pane.js";
import { setupStages } from "./trial/setup.js";
import { LiveSocket } from "./live/socket.js";
import { StopRoute } from "./commands/stop_route.js";
import { statusBar } from "./live/status.js";
import { currentStep, showStep } from "./trial/steps.js";
import { Store } from "./live/store.js";
import { tour } from "./tour.js";
import { TrialPanel } from "./trial/trial.js";
import { applyRedaction } from "./trial/redaction.js";
import { CLOSE_REASONS } from "./live/labels.js";

/** Return the handler of the socket's messages; those for one part of the page go to the listeners of the store. */
function listen(store, events) {
  const answers = {
    hello: ({ facts, role }) => {
      store.closed = null;
      store.facts = facts;
      store.role = role ?? store.role;
      store.tell("hello");
    },
    link: (link) => {
      store.link = { ...link, told: true }; // until then a missing link is no problem
      store.tell("link");
    },
    events: (news) => events.add(news),
    ack: (ack) => store.tell("ack", ack),
    // The id of the answer is that of the request.
    aimed: (answer) => store.tell("aimed", { ...answer, reason: sentence({ ...answer.sentence, text: answer.reason }) }),
    renewed: (answer) => store.tell("renewed", answer),
    changed: ({ what }) => store.tell("changed", what),
    error: ({ reason }) => console.error(`the server did not understand this page: ${reason}`),
  };
  return (message) => answers[message.type]?.(reasoned(message));
}

async function start() {
  quietFragments(); // before anything changes what the server rendered
  drafts();
  const store = new Store({ user: config.user, role: config.role, page: await pageId() });
  const events = new Events();
  const cameras = new Cameras(store);
  const way = new StopRoute(config.stops, config.api);
  const socket = new LiveSocket(`${config.socket}?page=${store.page}`, {
    told: listen(store, events),
    draw: (frame) => drawFrame(frame, store, cameras),
    changed: (open, code) => {
      store.open = open;
      if (!open) Object.assign(store, { closed: CLOSE_REASONS[code] ?? null, link: { ok: false, reason: "" } });
      store.tell("open");
    },
    greet: ({ again = false } = {}) => {
      if (!again) socket.send({ type: "watch", streams: ["state", "joints", "recent", "poses", "chunk", ...cameras.streams] });
      socket.send({ type: "events", after: events.newest, boot: events.boot });
    },
    expected: () => store.link.ok,
  });
  new EStop(store, socket, way); // before any other control
  keyboard((words) => commands.say(words, "refused"));
  statusBar(store);
  const commands = new Commands(store, socket, way);
  new LeaseControls(store, socket, commands);
  if (config.page === "eval") {
    tour(store);
    new TrialPanel(store, commands);
    resetAid(regionView());
  }
  if (config.page === "debug") byHand(store, socket, commands);
  applyRedaction(store);
  if (config.page === "collect") new CollectPanel(store, commands);
  setupStages(store);
  preflights(store, commands);
  figures(store);
  store.on(["snapshot", "second"], () => steps(store));
  document.body.addEventListener("htmx:afterSettle", () => steps(store));
  steps(store);
  setInterval(() => store.tell("second"), 500);
  const joints = ({ joint_names: names, units, gripper_dims: grippers }) => names?.length && panes.curves.joints(names, units ?? config.units, grippers ?? config.grippers);
  store.on("snapshot", ({ facts }) => facts && joints(facts));
  store.on("snapshot", (snapshot) => snapshot.truth && panes.scene.bench(snapshot.truth));
  scenePane(store).then((pane) => Object.assign(panes, { scene: pane }));
  curvePane(store).then((pane) => Object.assign(panes, { curves: pane }));
}

function steps(store) {
  const element = document.getElementById("steps");
  showStep(element, currentStep(element.dataset, store.snapshot));
}

start();
