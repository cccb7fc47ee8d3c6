// SPDX-License-Identifier: Apache-2.0
//
// The dialog that has a range of time saved as a recording, as far as the rings still hold it, and
// downloads that.
import { LostError, RequestError } from "./connection.js";
import { bytes, counted, element, setText, wholeDuration } from "./format.js";

const kAnswerMs = 600000; // a host that is slow, a large ring
const kLengths = [10, 30, 60, 300]; // seconds
const kAroundS = 10;

export class SaveDialog {
  // page: returns the page that shows samples, or null
  constructor(dialog, { connection, time, signals, page }) {
    Object.assign(this, { dialog, connection, time, signals, page });
    const find = (id) => dialog.querySelector(`#${id}`);
    this.range = find("save-range");
    this.streams = find("save-streams");
    this.button = find("save-now");
    this.result = find("save-result");
    this.button.addEventListener("click", () => this.save());
  }

  open() {
    if (this.time.recorded || this.dialog.open) return;
    this.choices = this.ranges();
    this.range.replaceChildren(...this.choices.map(({ text }, i) => new Option(text, i)));
    const shown = this.page()?.chosenStreams() ?? [];
    this.streams.replaceChildren(
      new Option("all", "all"),
      ...(shown.length > 0 ? [new Option(`those shown here (${shown.length})`, "shown")] : []),
    );
    this.result.replaceChildren();
    this.dialog.showModal();
  }

  // What may be saved: {text, from, to}, or {text, last} of so long before the newest sample.
  ranges() {
    const seconds = (count) => BigInt(count) * 1000000000n;
    const { time, signals } = this;
    const choices = [];
    const isPlot = this.page() === signals && signals.window && (signals.zoom || time.t !== null);
    if (isPlot) choices.push({ text: "the window of the plots", ...signals.window });
    if (time.t !== null) {
      choices.push({
        text: `${kAroundS} s before and after the instant shown`,
        from: time.t - seconds(kAroundS),
        to: time.t + seconds(kAroundS),
      });
    }
    if (time.range) {
      for (const length of kLengths) {
        choices.push({ text: `the last ${wholeDuration(length)}`, last: seconds(length) });
      }
    }
    choices.push({ text: "all that the rings hold", from: 0n, to: null });
    return choices;
  }

  async save() {
    const { last, from = this.time.range.newest - last, to = null } =
      this.choices[Number(this.range.value)];
    const parameters = { from_ns: String(from), to_ns: to === null ? null : String(to) };
    if (this.streams.value === "shown") parameters.streams = this.page().chosenStreams();
    this.button.disabled = true;
    setText(this.result, "Saving \u2026");
    try {
      this.show(await this.connection.request("save", parameters, kAnswerMs));
    } catch (error) {
      if (!(error instanceof RequestError || error instanceof LostError)) throw error;
      setText(this.result, `It could not be saved: ${error.message}`);
    }
    this.button.disabled = false;
  }

  show(answer) {
    const { path, samples, streams, lost_samples: lost, file_bytes: size, notices } = answer;
    const name = path.slice(path.lastIndexOf("/") + 1);
    const link = element("a", { href: path, download: name }, name);
    const text =
      `: ${counted(samples, "sample")} of ${counted(streams, "stream")}, ${bytes(size)}` +
      (lost > 0 ? `; ${lost} lost` : "");
    this.result.replaceChildren(
      element("p", {}, link, text),
      ...notices.map((notice) => element("p", { class: "notice" }, notice)),
    );
    if (samples > 0) link.click();
  }
}
