// Uploads that continue after a broken connection, a pause, or a reload of the page: the server knows what it has.

import { all, Problem, request, send } from "./api";
import { pause } from "./events";
import type { JobError, UploadedFile } from "./types";

const PIECE_BYTES = 16 * 1024 * 1024;
const AT_ONCE = 4;
const TRIES = 6;

export interface Item {
  path: string;
  file: File;
}

export interface Progress {
  sent: number;
  total: number;
  files: number;
  filesDone: number;
  bytesPerSecond: number;
  trouble: string;
}

const ARCHIVE = /\.(zip|tar|tgz|tar\.gz|tar\.bz2|tbz2|tar\.xz|txz)$/i;

export function isArchive(items: Item[]): boolean {
  return items.length === 1 && ARCHIVE.test(items[0]?.file.name ?? "");
}

/** Paths inside the dataset: the folder that was chosen is taken away where all files lie in it, unless it is `parts` of one. */
export function withoutCommonFolder(items: Item[], parts: ReadonlySet<string> = new Set()): Item[] {
  const first = items[0]?.path.split("/")[0] ?? "";
  const common = items.length > 0 && !parts.has(first) && items.every((item) => item.path.startsWith(`${first}/`));
  const kept = common ? items.map((item) => ({ ...item, path: item.path.slice(first.length + 1) })) : items;
  return kept.filter((item) => !item.path.split("/").some((part) => part.startsWith(".") || part === "__MACOSX"));
}

/** Paths inside the dataset of files that mend `wrong`: that file itself, what belongs into that folder, or all files again. */
export function placedAt(items: Item[], wrong: string): Item[] {
  const loose = items.every((item) => !item.path.includes("/"));
  if (!loose) return withoutCommonFolder(items, new Set([wrong.split("/")[0] ?? ""]));
  const [only] = items;
  const name = wrong.split("/").pop() ?? "";
  const folder = name.includes(".") ? wrong.slice(0, Math.max(0, wrong.length - name.length)) : `${wrong}/`;
  if (items.length === 1 && only !== undefined && isArchive(items)) return items;
  return items.map((item) => ({ ...item, path: item.path === "config.yaml" ? item.path : `${folder}${item.path}` }));
}

/** Files and folders that were dropped, with their paths. */
export async function dropped(transfer: DataTransfer): Promise<Item[]> {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const items: Item[] = [];
  for (const entry of entries) await walk(entry, "", items);
  return items;
}

async function walk(entry: FileSystemEntry, above: string, items: Item[]): Promise<void> {
  const path = above === "" ? entry.name : `${above}/${entry.name}`;
  if (entry.isFile) {
    const file = await new Promise<File>((resolve, reject) => {
      (entry as FileSystemFileEntry).file(resolve, reject);
    });
    items.push({ path, file });
    return;
  }
  const reader = (entry as FileSystemDirectoryEntry).createReader();
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((resolve, reject) => {
      reader.readEntries(resolve, reject);
    });
    if (some.length === 0) return;
    for (const child of some) await walk(child, path, items);
  }
}

const TEXT = /\.(txt|ya?ml)$/i;
const MOST_TEXT = 8 * 1024 * 1024;
const MOST_LINES = 15 * 1024 * 1024;

/** What the server's reader finds wrong with names, parts of a bag, poses and calibration, before anything is sent; null: nothing, or not known. */
export async function checkNames(items: Item[], folder: string): Promise<JobError | null> {
  if (isArchive(items)) return null;
  const lines = await Promise.all(items.map(async ({ path, file }) =>
    JSON.stringify(TEXT.test(path) && file.size <= MOST_TEXT ? { path, text: await file.text() } : { path })));
  const body = new Blob([lines.join("\n")]);
  if (body.size > MOST_LINES) return null;
  try {
    const response = await request(`/v1/checks?name=${encodeURIComponent(folder)}`, { method: "POST", body, headers: { "Content-Type": "application/x-ndjson" } });
    return ((await response.json()) as { error: JobError | null }).error;
  } catch (error) {
    // what cannot be asked now is found out after the upload
    if (error instanceof Problem && error.status === 401) throw error;
    return null;
  }
}

/** One upload of files into a dataset. `run` may be called again after it failed or was stopped. */
export class Upload {
  private sent = new Map<string, number>();
  private marks: { time: number; bytes: number }[] = [];
  private trouble = "";

  constructor(
    readonly dataset: string,
    readonly items: Item[],
    /** What the server found wrong: sent anew, whatever it has of it. */
    private readonly wrong: string | null,
    private readonly tell: (progress: Progress) => void,
  ) {}

  async run(signal: AbortSignal): Promise<void> {
    this.marks = [];
    if (isArchive(this.items) && this.items[0] !== undefined) {
      await this.sendFile(`/v1/datasets/${this.dataset}/archive`, this.items[0], signal);
      return;
    }
    const known = await all<UploadedFile>(`/v1/datasets/${this.dataset}/files`, 1_000_000);
    const there = new Map(known.map((file) => [file.path, file]));
    const waiting: Item[] = [];
    const begun = new Set<string>();
    for (const item of this.items) {
      const state = await this.stateOf(item, there.get(item.path));
      if (state === "there") this.sent.set(item.path, item.file.size);
      else waiting.push(item);
      if (state === "begun") begun.add(item.path);
    }
    this.report();
    const worker = async (): Promise<void> => {
      for (let item = waiting.shift(); item !== undefined && !signal.aborted; item = waiting.shift()) {
        const path = item.path.split("/").map(encodeURIComponent).join("/");
        await this.sendFile(`/v1/datasets/${this.dataset}/files/${path}`, item, signal, !begun.has(item.path));
      }
    };
    await Promise.all(Array.from({ length: AT_ONCE }, worker));
    if (signal.aborted) throw new DOMException("stopped", "AbortError");
  }

  /** Whether a file is there as it is here, has begun to arrive, or must be sent from its beginning. */
  private async stateOf(item: Item, known: UploadedFile | undefined): Promise<"there" | "begun" | "new"> {
    if (known === undefined || known.length !== item.file.size || (known.path === this.wrong && !this.sent.has(item.path))) return "new";
    if (!known.complete) return "begun";
    // the same length does not make it the same file; what is large is not read for that alone
    if (this.wrong === null || item.file.size > PIECE_BYTES || !window.isSecureContext) return "there";
    return known.sha256 === (await hex(item.file)) ? "there" : "new";
  }

  /** Tells the server that all is there. */
  async finish(): Promise<void> {
    await send("POST", `/v1/datasets/${this.dataset}/finish`);
  }

  private async sendFile(url: string, item: Item, signal: AbortSignal, fresh = false): Promise<void> {
    let offset = fresh ? 0 : await offsetOf(url);
    let failures = 0;
    while (!signal.aborted) {
      try {
        const piece = item.file.slice(offset, offset + PIECE_BYTES);
        const received = await this.sendPiece(url, item, piece, offset, signal);
        failures = 0;
        this.trouble = "";
        offset = received;
        this.sent.set(item.path, offset);
        this.report();
        if (offset >= item.file.size) return;
      } catch (error) {
        if (signal.aborted) break;
        if (!worthAnotherTry(error) || ++failures >= TRIES) throw error;
        this.trouble = "The connection is gone or slow: trying again.";
        this.report();
        await pause(waitMs(error, failures), signal);
        offset = await offsetOf(url).catch(() => offset);
      }
    }
    throw new DOMException("stopped", "AbortError");
  }

  private async sendPiece(url: string, item: Item, piece: Blob, offset: number, signal: AbortSignal): Promise<number> {
    const extra: Record<string, string> = {
      "Content-Type": "application/octet-stream",
      "Upload-Offset": String(offset),
      "Upload-Length": String(item.file.size),
    };
    const digest = await contentDigest(piece);
    if (digest !== "") extra["Content-Digest"] = digest;
    const response = await request(url, { method: "PUT", body: piece, headers: extra, signal });
    await response.arrayBuffer(); // an answer that nobody reads counts as given up
    return Number(response.headers.get("Upload-Offset") ?? offset + piece.size);
  }

  private report(): void {
    const sent = [...this.sent.values()].reduce((sum, value) => sum + value, 0);
    const now = performance.now();
    this.marks = [...this.marks.filter((mark) => now - mark.time < 8000), { time: now, bytes: sent }];
    const first = this.marks[0] ?? { time: now, bytes: sent };
    const seconds = (now - first.time) / 1000;
    const filesDone = this.items.filter((item) => this.sent.get(item.path) === item.file.size).length;
    this.tell({
      sent,
      total: this.items.reduce((sum, item) => sum + item.file.size, 0),
      files: this.items.length,
      filesDone,
      bytesPerSecond: seconds > 0.2 ? (sent - first.bytes) / seconds : 0,
      trouble: this.trouble,
    });
  }
}

async function offsetOf(url: string): Promise<number> {
  try {
    const response = await request(url, { method: "HEAD" });
    return Number(response.headers.get("Upload-Offset") ?? 0);
  } catch (error) {
    if (error instanceof Problem && error.status === 404) return 0;
    throw error;
  }
}

function worthAnotherTry(error: unknown): boolean {
  if (!(error instanceof Problem)) return true;
  const again = ["offset-mismatch", "locked", "digest-mismatch", "too-many-requests", "unavailable"];
  return error.status >= 500 ? error.code !== "disk-full" : again.includes(error.code);
}

function waitMs(error: unknown, failures: number): number {
  if (error instanceof Problem && error.code === "offset-mismatch") return 50;
  if (error instanceof Problem && error.retryAfter !== null) return error.retryAfter * 1000;
  return Math.min(10_000, 400 * 2 ** failures);
}

/** RFC 9530; "" where the browser has no digests (pages that came over plain http). */
async function contentDigest(piece: Blob): Promise<string> {
  if (!window.isSecureContext) return "";
  const sum = await crypto.subtle.digest("SHA-256", await piece.arrayBuffer());
  return `sha-256=:${btoa(String.fromCharCode(...new Uint8Array(sum)))}:`;
}

async function hex(file: Blob): Promise<string> {
  const sum = await crypto.subtle.digest("SHA-256", await file.arrayBuffer());
  return [...new Uint8Array(sum)].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}
