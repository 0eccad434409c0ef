// Server-sent events over fetch (the header carries the key), taken up again where a broken connection left off.

import { headers, Problem, problemOf } from "./api";

export interface ServerEvent {
  id: string;
  event: string;
  data: Record<string, unknown>;
}

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 15_000;

/**
 * Follows a stream of events until the signal stops it or the stream ends by itself (`end` event).
 * connected: called whenever the line comes up or goes down.
 */
export async function follow(
  path: string,
  signal: AbortSignal,
  take: (event: ServerEvent) => void,
  connected: (up: boolean) => void,
): Promise<void> {
  let last = "";
  let wait = FIRST_WAIT_MS;
  let ended = false;
  while (!signal.aborted && !ended) {
    try {
      const extra: Record<string, string> = last === "" ? {} : { "Last-Event-ID": last };
      const response = await fetch(path, { headers: { ...headers(), ...extra, Accept: "text/event-stream" }, signal });
      if (!response.ok) throw await problemOf(response);
      connected(true);
      wait = FIRST_WAIT_MS;
      for await (const event of parse(response)) {
        if (event.id !== "") last = event.id;
        take(event);
        if (event.event === "end") ended = true;
      }
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof Problem && error.status < 500 && error.status !== 429) {
        connected(false);
        return;
      }
    }
    if (ended) return;
    connected(false);
    await pause(wait, signal);
    wait = Math.min(LONGEST_WAIT_MS, wait * 2);
  }
}

async function* parse(response: Response): AsyncGenerator<ServerEvent> {
  if (response.body === null) return;
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      rest += value.replaceAll("\r\n", "\n");
      const blocks = rest.split("\n\n");
      rest = blocks.pop() ?? "";
      for (const block of blocks) {
        const event = one(block);
        if (event !== null) yield event;
      }
    }
  } finally {
    reader.releaseLock();
  }
}

function one(block: string): ServerEvent | null {
  const event = { id: "", event: "message", data: [] as string[] };
  for (const line of block.split("\n")) {
    const at = line.indexOf(":");
    if (at <= 0) continue; // a comment, or nothing
    const value = line.slice(at + 1).replace(/^ /, "");
    const name = line.slice(0, at);
    if (name === "id") event.id = value;
    else if (name === "event") event.event = value;
    else if (name === "data") event.data.push(value);
  }
  if (event.data.length === 0) return null;
  try {
    return { id: event.id, event: event.event, data: JSON.parse(event.data.join("\n")) as Record<string, unknown> };
  } catch {
    return null;
  }
}

export function pause(ms: number, signal?: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      resolve();
    });
  });
}
